"""From which scatter of the inputs on derivatives no longer tell a quantity's uncertainty."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.study.uncertainty.moments import (
    ERRORS,
    expanded_members,
    first_order_error,
    members_statistics,
    scatter_limit,
    sobol_members,
)
from snrmjax.study.uncertainty.propagation import (
    DEFAULT_PROPAGATION,
    WRONG,
    PropagationSettings,
    members_per_scrambling,
)
from snrmjax.study.uncertainty.quantities import AbstractQuantities


class ScatterStudy(AbstractResult):
    """The error of first order against the scale of all inputs' scatter, by quasi-Monte Carlo."""

    coordinates: ClassVar[tuple[str, ...]] = ("scale", "error", "quantity")

    scale: Float[np.ndarray, " scale"]
    first_order_error: Float[np.ndarray, "scale error quantity"]
    second_order_error: Float[np.ndarray, "scale error quantity"]  # likewise of second order
    share_found: Float[np.ndarray, "scale quantity"]  # of the members
    limit: Float[np.ndarray, "error quantity"]  # scale at which first order errs by 10 %
    predicted_limit: Float[np.ndarray, "error quantity"]  # the same by second order
    names: tuple[str, ...] = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """The scatter from which first order errs by 10 %, of every quantity."""
        rows = zip(self.names, self.limit.T, self.predicted_limit.T, strict=True)
        return (
            f"error of first order at {len(self.scale)} scales of the inputs' scatter, from"
            f" {self.scale[0]:.3g} to {self.scale[-1]:.3g}",
            *(
                f"{name}: its 95 % range errs by 10 % from {own[2]:.3g} times the stated scatter"
                f" on (predicted by second order: {predicted[2]:.3g})"
                for name, own, predicted in rows
            ),
        )

    def variables(self) -> dict[str, Variable]:
        """Errors and shares by scale, and the limits; infinite: not reached at these scales."""
        of, limit = ("scale", "error", "quantity"), ("error", "quantity")
        return {
            "scale": Variable(("scale",), self.scale, "1", "factor on the stated scatter"),
            "error": Variable(("error",), np.array(ERRORS), "", "in which first order errs"),
            "quantity": Variable(("quantity",), np.array(self.names), "", "quantity"),
            "first_order_error": Variable(of, self.first_order_error, "1", "of first order"),
            "second_order_error": Variable(of, self.second_order_error, "1", "of second order"),
            "share_found": Variable(
                ("scale", "quantity"), self.share_found, "1", "members at which it exists"
            ),
            "limit": Variable(limit, self.limit, "1", "scale of a 10 % error"),
            "predicted_limit": Variable(limit, self.predicted_limit, "1", "by second order"),
        }


def scatter_study(
    quantities: AbstractQuantities,
    scales: Float[np.ndarray, " scale"],
    settings: PropagationSettings = DEFAULT_PROPAGATION,
) -> ScatterStudy:
    """How the error of first and second order grows with the scatter of the inputs.

    All standard normal numbers are multiplied by each scale; the members are those of one
    scrambled Sobol' sequence at every scale, so that the error is a smooth function of it. The
    limit of 10 % is interpolated between the scales.
    Raises `ValueError` for scales that are not positive and rising.
    """
    factors = np.asarray(scales, dtype=np.float64)
    if factors.ndim != 1 or not np.all(np.diff(np.append(0.0, factors)) > 0):
        raise ValueError(f"`scales` must be positive and rising, but are {factors.tolist()}.")
    members_per_scrambling(settings)
    (z,) = sobol_members(settings.members, len(quantities.inputs.names), 1, settings.seed)
    expansion = quantities.expansion()
    errors, second_errors, shares = [], [], []
    for scale in factors.tolist():
        found = quantities.members(scale * z)
        reference = members_statistics(found.values)
        linear, quadratic = map(members_statistics, expanded_members(expansion, scale * z))
        errors.append(first_order_error(linear, reference))
        second_errors.append(first_order_error(quadratic, reference))
        shares.append(np.mean(np.isfinite(found.values), axis=0))
    return ScatterStudy(
        scale=factors,
        first_order_error=np.stack(errors),
        second_order_error=np.stack(second_errors),
        share_found=np.stack(shares),
        limit=_passed(factors, np.stack(errors), WRONG),
        predicted_limit=scatter_limit(expansion, WRONG),
        names=tuple(quantities.names),
    )


def _passed(scales: np.ndarray, errors: np.ndarray, level: float) -> np.ndarray:
    """The scale at which each error first passes a level, by power laws between the scales."""
    result = np.full(errors.shape[1:], np.inf)
    for place in np.ndindex(*result.shape):
        own = errors[(slice(None), *place)]
        above = np.flatnonzero(own > level)
        if above.size:
            k = int(above[0])
            result[place] = scales[k]
            if k > 0:
                ends, steps = np.log(own[k - 1 : k + 1]), np.log(scales[k - 1 : k + 1])
                result[place] = np.exp(np.interp(np.log(level), ends, steps))
    return result
