"""Uncertainty of peaks, folds and resonances by derivatives, of first and of second order."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats

from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.study.uncertainty.quantities import Quantities

METHOD_NAMES = ("first order", "second order")
STATISTICS = ("mean", "std", "lower", "upper")  # lower, upper: 2.5 and 97.5 % points
ERRORS = ("mean", "std", "range")
_TAILS = (0.025, 0.975)
_MEMBERS = 2**14  # samples of a quadratic for its percentage points
_SCALES = np.geomspace(1e-3, 1e3, 121)
_WRONG = 0.1  # error of first order above which a note is given

Statistics = Float[np.ndarray, "statistic quantity"]


class Propagation(AbstractResult):
    """Mean, standard deviation and 95 % range of quantities by first and by second order.

    `first_order_error` is the error of first order relative to second order: of its mean in
    standard deviations, of its standard deviation, and of the worse end of its 95 % range in half
    widths. `scatter_limit` is the factor on all inputs' scatter at which it reaches 10 %: 1 is the
    stated scatter.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("quantity", "approach", "statistic", "error")

    quantities: Quantities
    statistics: Float[np.ndarray, "method statistic quantity"] = quantity(
        "approach statistic quantity", "SI", "statistic", name="value"
    )
    first_order_error: Float[np.ndarray, "error quantity"] = quantity(
        "error quantity", "1", "error of first order"
    )
    scatter_limit: Float[np.ndarray, "error quantity"] = quantity(
        "error quantity", "1", "scatter of a 10 % error"
    )
    notes: tuple[Fact, ...] = setting()

    def summary(self) -> tuple[str, ...]:
        """A line per quantity and method, then the notes."""
        about = self.quantities
        lines = [
            f"uncertainty of {len(about.names)} quantities by {about.gradient.shape[1]} numbers"
        ]
        for q, name in enumerate(about.names):
            lines.append(f"{name}: {about.value[q]:.6g} at the medians")
            for method, (mean, std, lower, upper) in zip(
                METHOD_NAMES, self.statistics[:, :, q], strict=True
            ):
                lines.append(
                    f"  {method}: {mean:.6g} ± {std:.3g} (1σ), 95 % from {lower:.6g} to {upper:.6g}"
                )
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """Statistics by method, errors of first order, and the values at the medians."""
        labels = {
            "quantity": (self.quantities.names, "quantity"),
            "approach": ([name.replace(" ", "_") for name in METHOD_NAMES], "method"),
            "statistic": (STATISTICS, "statistic"),
            "error": (ERRORS, "in which first order errs"),
        }
        return {
            **{k: Variable((k,), np.array(names), "", text) for k, (names, text) in labels.items()},
            "nominal": Variable(("quantity",), self.quantities.value, "SI", "at the medians"),
            **super().variables(),
        }


@on_numbers(
    "`sj.study.response_quantities` gives derivatives; in a program of your own "
    "differentiate `sj.simulate.periodic_motion`."
)
def propagate_uncertainty(quantities: Quantities) -> Propagation:
    """Uncertainty of quantities from that of their inputs, by derivatives at the medians.

    With the quantity f(z) of independent standard normal numbers z, its gradient g and Hessian H at
    z = 0 (automatic differentiation), first order has mean f(0) and variance gᵀg, second order
    mean f(0) + ½ tr H, variance gᵀg + ½ tr H² and the percentage points of the quadratic. Notes
    name the quantities with a first-order error above 10 %.

    Arguments: `quantities` by `response_quantities`, or `function_quantities` of your own function.
    Validity: local derivatives at the medians; for larger scatter make a `Study` of the same
    variations.
    Not differentiable: `snrmjax.study.response_quantities` gives derivatives; in a program of your
    own differentiate `snrmjax.simulate.periodic_motion`.
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
    worst = np.nanmax(error, axis=0, initial=0.0)
    notes = [
        Fact(
            "first_order_wrong",
            quantity=name,
            error=float(worst[q]),
            first=tuple(first[2:, q].tolist()),
            second=tuple(second[2:, q].tolist()),
            limit=float(limit[:, q].min()),
        )
        for q, name in enumerate(quantities.names)
        if worst[q] > _WRONG
    ]
    return Propagation(
        quantities=quantities,
        statistics=np.stack([first, second]),
        first_order_error=error,
        scatter_limit=limit,
        notes=(*quantities.notes, *notes),
    )


def first_order(about: Quantities, scale: float = 1.0) -> Statistics:
    """Statistics of the normal f₀ + gᵀz, z standard normal numbers times `scale`."""
    std = scale * np.linalg.norm(about.gradient, axis=1)
    half_width = float(stats.norm.ppf(_TAILS[1])) * std
    return np.stack([about.value, std, about.value - half_width, about.value + half_width])


def second_order(about: Quantities) -> Statistics:
    """Statistics of f₀ + gᵀz + ½ zᵀHz, z standard normal numbers.

    The mean f₀ + ½ tr H and the variance gᵀg + ½ tr H² are exact; the percentage points are
    those of 2^14 members of a Sobol' sequence.
    """
    linear, quadratic = _members(about)
    ends = about.value + np.quantile(linear + quadratic, _TAILS, axis=0)
    return np.stack([*_exact(about, 1.0), *ends])


def first_order_error(first: Statistics, reference: Statistics) -> Float[np.ndarray, "error q"]:
    """Error of first order relative to the reference's scatter; a row for each of `ERRORS`.

    Its mean in reference standard deviations; its standard deviation; and the worse end of its
    95 % range in half widths of the reference range.
    """
    std, half_width = reference[1], 0.5 * (reference[3] - reference[2])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.max(np.abs(first[2:] - reference[2:]), axis=0) / half_width
        mean = np.abs(first[0] - reference[0]) / std
        return np.stack([mean, np.abs(first[1] / std - 1), ends])


def scatter_limit(about: Quantities, error: float = 0.1) -> Float[np.ndarray, "error q"]:
    """The factor on all inputs' scatter at which the first-order error reaches `error`.

    1 is the stated scatter; a row for each of `ERRORS`, relative to second order. The first
    crossing by Brent's method; infinite where there is none up to a factor of 1000.
    """
    linear, quadratic = _members(about)

    def excess(scale: float) -> Float[np.ndarray, "error q"]:
        first = first_order(about, scale)
        # Both orders are sampled with the same members, so that the sampling error cancels.
        ends = first[2:] - np.quantile(scale * linear, _TAILS, axis=0)
        ends = ends + np.quantile(scale * linear + scale**2 * quadratic, _TAILS, axis=0)
        return first_order_error(first, np.stack([*_exact(about, scale), *ends])) - error

    above = np.array([excess(float(scale)) for scale in _SCALES]) > 0
    result = np.full(above.shape[1:], np.inf)
    for row, q in np.argwhere(above.any(axis=0)).tolist():
        k = int(np.argmax(above[:, row, q]))
        if k == 0:
            result[row, q] = 0.0  # no gradient: first order is wrong at any scatter
            continue
        root = optimize.brentq(
            lambda log_scale, row=row, q=q: excess(float(np.exp(log_scale)))[row, q],
            *np.log(_SCALES[k - 1 : k + 1]).tolist(),
            xtol=1e-4,
        )
        result[row, q] = np.exp(root)
    return result


def _exact(about: Quantities, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the quadratic."""
    curvature = scale**2 * about.hessian
    mean = about.value + 0.5 * np.trace(curvature, axis1=1, axis2=2)
    square = scale**2 * np.sum(about.gradient**2, axis=1) + 0.5 * np.sum(curvature**2, axis=(1, 2))
    return mean, np.sqrt(square)


def _members(about: Quantities) -> tuple[np.ndarray, np.ndarray]:
    """Linear and quadratic part of samples of the quadratic, for unit scatter."""
    n = about.gradient.shape[1]
    (seed,) = np.random.SeedSequence([0, 1]).spawn(1)
    sequence = stats.qmc.Sobol(n, rng=np.random.default_rng(seed))
    z = stats.qmc.MultivariateNormalQMC(np.zeros(n), engine=sequence).random(_MEMBERS)
    roughness = [0.5 * np.einsum("mi,ij,mj->m", z, h, z, optimize=True) for h in about.hessian]
    return z @ about.gradient.T, np.stack(roughness, axis=1)
