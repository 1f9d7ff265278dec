"""Uncertain numbers of a model and its force: their distribution, by standard normal numbers."""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from snrmjax.identify.calibrate.backbone_calibration import BackboneCalibration
from snrmjax.identify.calibrate.calibrated_model import CalibratedModel
from snrmjax.model.parameters import checked_names, parameter_values, stated_stds
from snrmjax.model.structures import Structure
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.study.variations import AbstractVariation, standard_normal

FORCE = "force_n"
Marginal = Literal["normal", "lognormal", "uniform"]


class UncertainInputs(AbstractResult):
    """Uncertain numbers by name, with the mean, covariance and kind of distribution of each.

    Every one is a function of independent standard normal numbers z: normal numbers and the
    logarithms of lognormal ones are linear in z (so that they may be correlated), a uniform one is
    the normal distribution's function of its own z. At z = 0 each has its median, which for
    a lognormal one is below its mean. Make them with `uncertain_inputs` or `correlated_inputs`.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("input",)

    mean: Float[np.ndarray, " input"]
    covariance: Float[np.ndarray, "input input"]
    centre: Float[np.ndarray, " input"]  # of the normal numbers behind them, see `values`
    factor: Float[np.ndarray, "input input"]  # lower triangular
    names: tuple[str, ...] = eqx.field(static=True)
    marginals: tuple[str, ...] = eqx.field(static=True)

    @property
    def std(self) -> Float[np.ndarray, " input"]:
        """1σ of every input."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def independent(self) -> bool:
        """Whether no two of them are correlated."""
        return bool(np.all(self.factor == np.diag(np.diag(self.factor))))

    def values(self, z: Float[ArrayLike, " input"]) -> Float[Array, " input"]:
        """The inputs at independent standard normal numbers, differentiable."""
        own = jnp.asarray(self.centre) + jnp.asarray(self.factor) @ jnp.asarray(z)
        kind = np.array(self.marginals)
        # Masked before the exponential: of numbers that are not logarithms it may overflow.
        grown = jnp.exp(jnp.where(kind == "lognormal", own, 0.0))
        half_width = jnp.sqrt(3 * jnp.diag(jnp.asarray(self.covariance)))
        spread = self.mean + half_width * (2 * jax.scipy.stats.norm.cdf(own) - 1)
        return jnp.where(kind == "lognormal", grown, jnp.where(kind == "uniform", spread, own))

    def variation(self) -> "InputVariation":
        """The same numbers as what varies between the members of a `Study`."""
        return InputVariation(self.names, self)

    def summary(self) -> tuple[str, ...]:
        """Every input with its mean and 1σ."""
        rows = zip(self.names, self.mean, self.std, self.marginals, strict=True)
        return (
            f"uncertain inputs: {len(self.names)}"
            f"{'' if self.independent else ', some of them correlated'}",
            *(f"{name} = {mean:.6g} ± {std:.2g} (1σ, {kind})" for name, mean, std, kind in rows),
        )

    def variables(self) -> dict[str, Variable]:
        """Mean, standard deviation, covariance and distribution of every input, in SI units."""
        at, across = ("input",), ("input", "other_input")
        return {
            "input": Variable(at, np.array(self.names), "", "name of the input"),
            "mean": Variable(at, self.mean, "SI", "mean"),
            "std": Variable(at, self.std, "SI", "1σ"),
            "marginal": Variable(at, np.array(self.marginals), "", "kind of distribution"),
            "covariance": Variable(across, self.covariance, "SI", "covariance"),
        }


class InputVariation(AbstractVariation):
    """Uncertain numbers, such as a calibration's posterior, as what varies in a study."""

    names: tuple[str, ...] = eqx.field(static=True)
    inputs: UncertainInputs

    def quantiles(self, unit: Float[np.ndarray, "member name"]) -> Float[np.ndarray, "member name"]:
        """See `AbstractVariation.quantiles`."""
        return np.asarray(jax.vmap(self.inputs.values)(jnp.asarray(standard_normal(unit))))


def uncertain_inputs(
    model: Structure,
    std: Mapping[str, float] | None = None,
    *,
    force: float | None = None,
    mean: Mapping[str, float] | None = None,
    marginals: Mapping[str, Marginal] | None = None,
) -> UncertainInputs:
    """Independent uncertain numbers of a model, and of its force.

    Arguments: `std` 1σ by the names of `snrmjax.model.parameter_names` or "force_n" (N), by default
    what the model states; `force` in N, the mean of "force_n"; `mean` where it is not
    the model's own value; `marginals` "normal" where nothing else is said.
    Raises `ValueError` for an unknown name, a standard deviation that is not positive, a
    lognormal number with a mean that is not, and where neither `std` nor the model state any.

    >>> from snrmjax.model import curved_beam
    >>> inputs = uncertain_inputs(curved_beam(), {"mode_1.damping_ratio": 0.005, "force_n": 1e-5},
    ...     force=6e-4, marginals={"mode_1.damping_ratio": "lognormal"})
    >>> [f"{value:.4g}" for value in inputs.values([0.0, 1.0])]
    ['0.04975', '0.00061']
    """
    stds = dict(stated_stds(model) if std is None else std)
    if not stds:
        raise ValueError(
            "the model states no standard deviation of its parameters: give `std`, a 1σ by name."
        )
    names, own = tuple(stds), parameter_values(model)
    checked_names(model, [name for name in names if name != FORCE] or [next(iter(own))])
    if (force is None) == (FORCE in names):
        verb = "needs" if force is None else "takes no"
        raise ValueError(f"`std` with{'' if force is None else 'out'} {FORCE!r} {verb} `force`.")
    means = {**own, **({} if force is None else {FORCE: float(force)}), **(mean or {})}
    for given, what in ((mean or {}, "mean"), (marginals or {}, "marginals")):
        for name in given:
            if name not in names:
                raise ValueError(f"`{what}` names {name!r}, which is not among `std`.")
    variance = np.diag([float(stds[name]) ** 2 for name in names])
    for name in names:
        if not 0 < stds[name] < np.inf:
            raise ValueError(f"the `std` of {name!r} must be positive, but is {stds[name]!r}.")
    kinds = [(marginals or {}).get(name, "normal") for name in names]
    return correlated_inputs(names, [means[name] for name in names], variance, kinds)


def correlated_inputs(
    names: Sequence[str],
    mean: Sequence[float] | Float[ArrayLike, " input"],
    covariance: Float[ArrayLike, "input input"],
    marginals: Sequence[Marginal] | None = None,
) -> UncertainInputs:
    """Inputs with a covariance; of a lognormal one it is its own, not its logarithm's.

    Raises `ValueError` where shapes disagree, for a name given twice, a covariance that is
    not symmetric or not positive definite, a lognormal input with a mean that is not positive or
    with a correlation that no lognormal numbers have, and for a uniform input that is correlated.
    """
    n, middle = len(names), np.asarray(mean, dtype=np.float64)
    spread = np.asarray(covariance, dtype=np.float64)
    kinds = tuple(marginals) if marginals is not None else ("normal",) * n
    if middle.shape != (n,) or spread.shape != (n, n) or len(kinds) != n:
        raise ValueError(
            f"{n} inputs need as many means and marginals and a covariance of shape {(n, n)}, but"
            f" have shapes {middle.shape}, {(len(kinds),)} and {spread.shape}."
        )
    for k, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        if list(names).count(name) > 1:
            raise ValueError(f"the input {name!r} is given twice.")
        if kind not in get_args(Marginal):
            raise ValueError(
                f"the marginal of {name!r} must be one of {get_args(Marginal)}, but is {kind!r}."
            )
        if not (np.isfinite(middle[k]) and 0 < spread[k, k] < np.inf):
            raise ValueError(
                f"{name!r} needs a finite mean and a positive variance, but they are"
                f" {middle[k]:g} and {spread[k, k]:g}."
            )
        if kind == "lognormal" and not middle[k] > 0:
            raise ValueError(f"{name!r} is lognormal, but its mean {middle[k]:g} is not positive.")
        others = np.delete(spread[k], k)
        if kind == "uniform" and np.any(others != 0):
            raise ValueError(f"{name!r} is uniform: it cannot be correlated with other inputs.")
    if not np.all(np.abs(spread - spread.T) <= 1e-9 * np.sqrt(np.outer(*[np.diag(spread)] * 2))):
        raise ValueError("the covariance of the inputs is not symmetric.")
    centre, factor = _behind(middle, spread, kinds)
    return UncertainInputs(middle, spread, centre, factor, tuple(names), kinds)


def posterior_inputs(calibrated: CalibratedModel | BackboneCalibration) -> UncertainInputs:
    """The fitted parameters of a calibration with their covariance, normally distributed.

    Raises `ValueError` for a calibration that did not converge.
    """
    if not calibrated.converged:
        raise ValueError(
            f"the calibration did not converge ({calibrated.status}): its covariance says nothing."
        )
    return correlated_inputs(calibrated.names, calibrated.values, calibrated.covariance)


def _behind(
    mean: np.ndarray, covariance: np.ndarray, kinds: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the normal numbers behind the inputs, and the factor of their covariance."""
    grown = np.array(kinds) == "lognormal"
    size = np.where(grown, mean, 1.0)
    relative = covariance / np.outer(size, size)
    with np.errstate(divide="ignore", invalid="ignore"):
        # cov(log X, log Y) = log(1 + cov(X, Y)/(μ ν)) and cov(log X, Y) = cov(X, Y)/μ, exactly.
        own = np.where(np.logical_and.outer(grown, grown), np.log1p(relative), relative)
    uniform = np.array(kinds) == "uniform"
    own[uniform, uniform] = 1.0
    centre = np.where(grown, np.log(size) - 0.5 * np.diag(own), np.where(uniform, 0.0, mean))
    scale = np.sqrt(np.diag(own))
    if not np.all(np.isfinite(own)):
        raise ValueError("no lognormal inputs have these correlations.")
    try:
        factor = scale[:, None] * np.linalg.cholesky(own / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise ValueError("the covariance of the inputs is not positive definite.") from None
    return centre, factor
