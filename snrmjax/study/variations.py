"""Variations between the members of a study: listed values and distributions."""

import abc
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from snrmjax.numerics.rules import POSITIVE, InputError

_FEWEST, _MOST = 2, 10_000_000  # values of a range
_NORMAL_LIMIT = 1e-12  # samples of the unit interval are clipped to this distance from 0 and 1
_ROUNDING = 1e-9  # of correlations, which files give with few digits


def _named(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _array(values: ArrayLike) -> np.ndarray:
    return np.asarray(values, dtype=np.float64)


class AbstractVariation(eqx.Module):
    """One varied quantity of a study, or several that vary together."""

    names: eqx.AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """Values at independent standard normal numbers, differentiable; the medians at zero.

        Arguments: `z` with a last axis of names; `xp` is NumPy or JAX.
        """

    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """Values at points of the unit cube, by the inverse distribution function."""
        from scipy.special import ndtri

        return self.at(ndtri(np.clip(unit, _NORMAL_LIMIT, 1 - _NORMAL_LIMIT)), np)

    def grid(self) -> Float[np.ndarray, " value"] | None:
        """The values of a grid; None for a distribution."""
        return None

    def _check(self, *positive: str) -> None:
        """Raise `ValueError` for a field that is not finite, and for one that is not positive."""
        title = ", ".join(self.names)
        for key, value in vars(self).items():
            if key != "names" and value is not None and not np.all(np.isfinite(_array(value))):
                raise InputError(f"`{key}` of {title} must be finite, but is {value}.")
        for key in positive:
            if not POSITIVE.good(getattr(self, key)):
                given = f"{getattr(self, key):g}"
                raise InputError(f"`{key}` of {title} must be {POSITIVE.expected}, but is {given}.")


class Discrete(AbstractVariation):
    """Listed values; a sample takes each of them equally often.

    Raises `ValueError` for no values and for one that is not finite.
    """

    names: tuple[str, ...] = eqx.field(converter=_named)
    values: Float[np.ndarray, " value"] = eqx.field(converter=lambda each: _array(each).ravel())

    def __check_init__(self) -> None:
        """Raises `ValueError`."""
        if not self.values.size:
            raise InputError(f"`values` of {self.names[0]} must have at least one number.")
        self._check()

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """Raises `ValueError`: listed values have no derivative."""
        raise InputError(f"{self.names[0]} takes listed values: derivatives need a distribution.")

    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """Each value on an equal part of the unit interval."""
        n = len(self.values)
        return self.values[np.minimum((unit * n).astype(int), n - 1)]

    def grid(self) -> Float[np.ndarray, " value"]:
        """The values."""
        return self.values


class Uniform(AbstractVariation):
    """A uniform distribution; a grid has `points` equally spaced values of it.

    Raises `ValueError` for an empty range and for too few points.
    """

    names: tuple[str, ...] = eqx.field(converter=_named)
    low: float = eqx.field(converter=float)
    high: float = eqx.field(converter=float)
    points: int | None = None

    def __check_init__(self) -> None:
        """Raises `ValueError`."""
        self._check()
        name, points = self.names[0], self.points
        if not self.low < self.high:
            ends = f"{self.low:g} to {self.high:g}"
            raise InputError(f"the range of {name} must rise, but goes from {ends}.")
        if points is not None and not _FEWEST <= points <= _MOST:
            raise InputError(f"`points` of {name} must be from {_FEWEST} to {_MOST}, not {points}.")

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """By the normal distribution function."""
        return self.low + (self.high - self.low) * jax.scipy.stats.norm.cdf(z)

    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """Linear in the point of the unit interval."""
        return self.low + (self.high - self.low) * unit

    def grid(self) -> Float[np.ndarray, " value"] | None:
        """The equally spaced values."""
        return None if self.points is None else np.linspace(self.low, self.high, self.points)


class Normal(AbstractVariation):
    """A normal distribution. Raises `ValueError` for a `std` that is not positive."""

    names: tuple[str, ...] = eqx.field(converter=_named)
    mean: float = eqx.field(converter=float)
    std: float = eqx.field(converter=float)

    def __check_init__(self) -> None:
        """Raises `ValueError`."""
        self._check("std")

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """Linear in the standard normal number."""
        return self.mean + self.std * z


class LogNormal(AbstractVariation):
    """A lognormal distribution by mean and standard deviation of the quantity itself.

    Raises `ValueError` for `mean` or `std` that is not positive.
    """

    names: tuple[str, ...] = eqx.field(converter=_named)
    mean: float = eqx.field(converter=float)
    std: float = eqx.field(converter=float)

    def __check_init__(self) -> None:
        """Raises `ValueError`."""
        self._check("mean", "std")

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """The exponential of a normal number."""
        variance = xp.log1p((self.std / self.mean) ** 2)
        return self.mean * xp.exp(xp.sqrt(variance) * z - variance / 2)


class MultivariateNormal(AbstractVariation):
    """Jointly normal quantities, such as a fit's posterior.

    Raises `ValueError` where shapes disagree, and for a covariance that is not symmetric, has a
    negative variance or is not positive semidefinite.
    """

    names: tuple[str, ...] = eqx.field(converter=_named)
    mean: Float[np.ndarray, " name"] = eqx.field(converter=_array)
    covariance: Float[np.ndarray, "name name"] = eqx.field(converter=_array)

    def __check_init__(self) -> None:
        """Raises `ValueError`."""
        title, n, variance = ", ".join(self.names), len(self.names), self.covariance
        if self.mean.shape != (n,) or variance.shape != (n, n):
            raise InputError(
                f"the joint normal of {title} needs {n} means and a covariance of {n} by {n}, but "
                f"has {self.mean.shape} and {variance.shape}."
            )
        self._check()
        k = int(np.argmin(np.diag(variance)))
        if variance[k, k] < 0:
            value = f"{variance[k, k]:g}"
            raise InputError(
                f"the variance of {self.names[k]} must not be negative, but is {value}."
            )
        scale = _scale(variance)
        correlation = variance / np.outer(scale, scale)
        if not np.allclose(correlation, correlation.T, rtol=0, atol=_ROUNDING):
            raise InputError(f"the covariance of {title} must be symmetric, but is not.")
        smallest = np.linalg.eigvalsh(correlation)[0]
        if smallest < -_ROUNDING * n:
            raise InputError(
                f"the covariance of {title} must be positive semidefinite, but the smallest "
                f"eigenvalue of its correlations is {smallest:.3g}."
            )

    def at(self, z: Any, xp: ModuleType = jnp) -> Any:
        """By a square root of the correlation matrix."""
        scale = _scale(self.covariance, xp)
        values, vectors = xp.linalg.eigh(self.covariance / xp.outer(scale, scale))
        root = scale[:, None] * vectors * xp.sqrt(xp.maximum(values, 0.0))
        return self.mean + z @ root.T


def _scale(covariance: Any, xp: ModuleType = np) -> Any:
    """Standard deviations, one for a quantity that does not vary."""
    std = xp.sqrt(xp.diag(covariance))
    return xp.where(std > 0, std, 1.0)
