"""What varies between the members of a study: values, ranges, distributions, joint normals."""

import abc
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from snrmjax.identify.calibrate.backbone_calibration import BackboneCalibration
from snrmjax.identify.calibrate.calibrated_model import CalibratedModel
from snrmjax.model.parameters import parameter_values, stated_stds
from snrmjax.model.structures import Structure

_FEWEST, _MOST = 2, 10_000_000
_NORMAL_LIMIT = 1e-12  # quantiles nearer to 0 or 1 than this have no place in a sample


class AbstractVariation(eqx.Module):
    """One quantity, or several that vary together, of the members of a study."""

    names: eqx.AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """Values at points of the unit cube, every one of which is as likely."""

    @abc.abstractmethod
    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """Values at independent standard normal numbers, differentiable; the medians at zero.

        Arguments: `z` with a last axis of names; `xp` is NumPy or JAX.
        """

    def grid(self) -> Float[np.ndarray, " value"] | None:
        """The values that a grid goes through; None where there are none."""
        return None


class AbstractNormal(AbstractVariation):
    """Quantities that are functions of standard normal numbers."""

    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """See `AbstractVariation.quantiles`."""
        return self.at(standard_normal(unit), np)


class ListedValues(AbstractVariation):
    """Values one by one; a sample takes each of them equally often."""

    names: tuple[str, ...]
    values: Float[np.ndarray, " value"]

    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """See `AbstractVariation.quantiles`."""
        n = len(self.values)
        return self.values[np.minimum((unit * n).astype(int), n - 1)]

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """Raises `ValueError`: what is listed has no derivative."""
        raise ValueError(f"{self.names[0]} takes listed values: derivatives need a distribution.")

    def grid(self) -> Float[np.ndarray, " value"]:
        """The values."""
        return self.values


class ValueRange(AbstractVariation):
    """Equally spaced values between two ends; a sample takes any value between them."""

    names: tuple[str, ...]
    low: float
    high: float
    points: int | None = None

    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """See `AbstractVariation.quantiles`."""
        return self.low + (self.high - self.low) * unit

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """See `AbstractVariation.at`."""
        return self.low + (self.high - self.low) * jax.scipy.stats.norm.cdf(z)

    def grid(self) -> Float[np.ndarray, " value"] | None:
        """The equally spaced values."""
        return None if self.points is None else np.linspace(self.low, self.high, self.points)


class Normal(AbstractNormal):
    """A normal distribution by mean and standard deviation."""

    names: tuple[str, ...]
    mean: float
    std: float

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """See `AbstractVariation.at`."""
        return self.mean + self.std * z


class LogNormal(AbstractNormal):
    """A lognormal distribution by the mean and standard deviation of the quantity itself."""

    names: tuple[str, ...]
    mean: float
    std: float

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """See `AbstractVariation.at`."""
        variance = xp.log1p((self.std / self.mean) ** 2)
        return self.mean * xp.exp(xp.sqrt(variance) * z - variance / 2)


class JointNormal(AbstractNormal):
    """Several quantities that are normal together, by mean and covariance."""

    names: tuple[str, ...]
    mean: Float[np.ndarray, " name"]
    covariance: Float[np.ndarray, "name name"]

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """See `AbstractVariation.at`."""
        scale = _scale(self.covariance, xp)
        values, vectors = xp.linalg.eigh(self.covariance / xp.outer(scale, scale))
        root = scale[:, None] * vectors * xp.sqrt(xp.maximum(values, 0.0))
        return self.mean + z @ root.T


def standard_normal(unit: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Quantiles of the standard normal distribution."""
    from scipy.special import ndtri

    return ndtri(np.clip(unit, _NORMAL_LIMIT, 1 - _NORMAL_LIMIT))


def listed(name: str, values: Float[ArrayLike, " value"]) -> ListedValues:
    """A quantity that takes given values. Raises `ValueError` for none and for one not finite."""
    each = np.asarray(values, dtype=np.float64).ravel()
    if not each.size:
        raise ValueError(f"`values` of {name} must have at least one number, but is empty.")
    _finite(name, values=each)
    return ListedValues((name,), each)


def ranged(name: str, low: float, high: float, points: int | None = None) -> ValueRange:
    """A quantity between two ends. Raises `ValueError` for an empty range or too few points."""
    _finite(name, low=low, high=high)
    if not low < high:
        raise ValueError(f"the range of {name} must rise, but goes from {low:g} to {high:g}.")
    if points is not None and not _FEWEST <= points <= _MOST:
        raise ValueError(f"`points` of {name} must be from {_FEWEST} to {_MOST}, not {points}.")
    return ValueRange((name,), float(low), float(high), points)


def normal(name: str, mean: float, std: float) -> Normal:
    """A normally distributed quantity. Raises `ValueError` for a `std` that is not positive."""
    _finite(name, mean=mean, std=std)
    _positive(name, std=std)
    return Normal((name,), float(mean), float(std))


def lognormal(name: str, mean: float, std: float) -> LogNormal:
    """A lognormal quantity. Raises `ValueError` for `mean` or `std` that is not positive."""
    _finite(name, mean=mean, std=std)
    _positive(name, mean=mean, std=std)
    return LogNormal((name,), float(mean), float(std))


def uniform(name: str, low: float, high: float) -> ValueRange:
    """A quantity that is equally likely between two ends."""
    return ranged(name, low, high)


def joint_normal(
    names: Sequence[str],
    mean: Float[ArrayLike, " name"],
    covariance: Float[ArrayLike, "name name"],
) -> JointNormal:
    """Quantities that are normal together, such as a fit's posterior.

    Raises `ValueError` where sizes disagree, and for a covariance that is not symmetric, has a
    negative variance or is not positive semidefinite.
    """
    center, cov = np.asarray(mean, np.float64), np.asarray(covariance, np.float64)
    title, n = ", ".join(names), len(names)
    if center.shape != (n,) or cov.shape != (n, n):
        raise ValueError(
            f"the joint normal of {title} needs {n} means and a covariance of {n} by {n}, but has "
            f"{center.shape} and {cov.shape}."
        )
    _finite(title, mean=center, covariance=cov)
    if np.any(np.diag(cov) < 0):
        k = int(np.argmin(np.diag(cov)))
        raise ValueError(f"the variance of {names[k]} must not be negative, but is {cov[k, k]:g}.")
    scale = _scale(cov)
    relative = cov / np.outer(scale, scale)
    if not np.allclose(relative, relative.T, rtol=0, atol=1e-9):
        raise ValueError(f"the covariance of {title} must be symmetric, but is not.")
    if np.linalg.eigvalsh(relative)[0] < -1e-9 * n:
        raise ValueError(
            f"the covariance of {title} must be positive semidefinite, but the smallest eigenvalue "
            f"of its correlations is {np.linalg.eigvalsh(relative)[0]:.3g}."
        )
    return JointNormal(tuple(names), center, (cov + cov.T) / 2)


def stated_variations(model: Structure) -> tuple[Normal, ...]:
    """The numbers of a model that state a standard deviation, as normally distributed quantities.

    Raises `ValueError` where none does.
    """
    own, stds = parameter_values(model), stated_stds(model)
    if not stds:
        raise ValueError("the model states no standard deviation of its parameters.")
    return tuple(normal(name, own[name], std) for name, std in stds.items())


def posterior_variation(calibrated: CalibratedModel | BackboneCalibration) -> JointNormal:
    """The fitted parameters of a calibration with their covariance, normally distributed.

    Raises `ValueError` for a calibration that did not converge.
    """
    if not calibrated.converged:
        raise ValueError(
            f"the calibration did not converge ({calibrated.status}): its covariance says nothing."
        )
    return joint_normal(calibrated.names, calibrated.values, calibrated.covariance)


def _scale(covariance: Any, xp: ModuleType = np) -> Any:
    """Standard deviations, one for a quantity that does not vary."""
    std = xp.sqrt(xp.diag(covariance))
    return xp.where(std > 0, std, 1.0)


def _finite(name: str, **numbers: ArrayLike) -> None:
    for key, value in numbers.items():
        if not np.all(np.isfinite(np.asarray(value, dtype=np.float64))):
            raise ValueError(f"`{key}` of {name} must be finite, but is {value}.")


def _positive(name: str, **numbers: float) -> None:
    for key, value in numbers.items():
        if not value > 0:
            raise ValueError(f"`{key}` of {name} must be positive, but is {value:g}.")
