"""Uncertainty of peaks, folds and resonances by derivatives, of first and of second order."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.study.uncertainty.moments import (
    ERRORS,
    STATISTICS,
    first_order,
    first_order_error,
    scatter_limit,
    second_order,
)
from snrmjax.study.uncertainty.quantities import Quantities

METHOD_NAMES = ("first order", "second order")
_WRONG = 0.1  # error of first order that is worth a note


class Propagation(AbstractResult):
    """Mean, standard deviation and 95 % range of quantities by first and by second order.

    `first_order_error` is what first order lacks against second order: of its mean in standard
    deviations, of its standard deviation, and of the farther end of its 95 % range in half widths.
    `scatter_limit` is the factor on all inputs' scatter from which that is 10 %: 1 is the scatter
    as stated.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("quantity", "approach", "statistic", "error")

    quantities: Quantities
    statistics: Float[np.ndarray, "method statistic quantity"]
    first_order_error: Float[np.ndarray, "error quantity"]
    scatter_limit: Float[np.ndarray, "error quantity"]
    notes: tuple[str, ...] = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """A line a quantity and method, then what is wrong."""
        about = self.quantities
        lines = [
            f"uncertainty of {len(about.names)} quantities by {about.gradient.shape[1]} numbers"
        ]
        for q, name in enumerate(about.names):
            lines.append(f"{name}: {about.value[q]:.6g} at the medians")
            for m, method in enumerate(METHOD_NAMES):
                mean, std, lower, upper = self.statistics[m, :, q]
                lines.append(
                    f"  {method}: {mean:.6g} ± {std:.3g} (1σ), 95 % from {lower:.6g} to {upper:.6g}"
                )
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """Statistics by method, and what first order lacks."""
        of, names = ("error", "quantity"), np.array(self.quantities.names)
        methods = np.array([name.replace(" ", "_") for name in METHOD_NAMES])
        return {
            "quantity": Variable(("quantity",), names, "", "quantity"),
            "approach": Variable(("approach",), methods, "", "method"),
            "statistic": Variable(("statistic",), np.array(STATISTICS), "", "statistic"),
            "error": Variable(("error",), np.array(ERRORS), "", "in which first order errs"),
            "nominal": Variable(("quantity",), self.quantities.value, "SI", "at the medians"),
            "value": Variable(
                ("approach", "statistic", "quantity"), self.statistics, "SI", "statistic"
            ),
            "first_order_error": Variable(of, self.first_order_error, "1", "error of first order"),
            "scatter_limit": Variable(of, self.scatter_limit, "1", "scatter of a 10 % error"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The notes."""
        return {"notes": "\n".join(self.notes)}


def propagate_uncertainty(quantities: Quantities) -> Propagation:
    """Uncertainty of quantities from that of their inputs, by derivatives at the medians.

    With f(z) the quantity by independent standard normal numbers, g its gradient and H its Hessian
    at z = 0 (automatic differentiation): first order is f(0) with variance gᵀg; second order
    f(0) + ½ tr H with variance gᵀg + ½ tr H² and the percentage points of the quadratic. Notes
    name the quantities of which first order is wrong by more than a tenth.

    Arguments: `quantities` by `response_quantities`, or `function_quantities` of your own function.
    Validity: the derivatives know nothing of what happens away from the medians. To solve members
    instead, make a `Study` of the same variations.
    Reference: Anderson, J. Aircraft 36 (1999) and Putko et al., J. Fluids Eng. 124 (2002) 60,
    doi:10.1115/1.1446068.

    >>> from snrmjax.study.uncertainty.quantities import function_quantities
    >>> from snrmjax.study.variations import Normal
    >>> square = function_quantities(lambda x: x**2, [Normal("x", 1.0, 0.2)], ["y"])
    >>> found = propagate_uncertainty(square)
    >>> found.statistics[:, 0, 0].round(6).tolist()
    [1.0, 1.04]
    """
    first, second = first_order(quantities), second_order(quantities)
    error, limit = first_order_error(first, second), scatter_limit(quantities)
    notes = [
        f"first order is wrong for {name} by {100 * worst:.0f} %: its 95 % range is"
        f" {first[2, q]:.6g} to {first[3, q]:.6g}, by second order {second[2, q]:.6g} to"
        f" {second[3, q]:.6g}; it errs by 10 % from {limit[:, q].min():.2g} times this scatter on"
        for q, (name, worst) in enumerate(
            zip(quantities.names, np.nanmax(error, axis=0, initial=0.0).tolist(), strict=True)
        )
        if worst > _WRONG
    ]
    return Propagation(
        quantities=quantities,
        statistics=np.stack([first, second]),
        first_order_error=error,
        scatter_limit=limit,
        notes=(*quantities.notes, *notes),
    )
