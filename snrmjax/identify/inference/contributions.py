"""Error budget of a joint fit: contribution of every source to the variance."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar, overload

import jax
import numpy as np
from jaxtyping import Float

from snrmjax.identify.inference.fitted_curves import values_at_displacement
from snrmjax.identify.joint.force_balance import STATE_ERRORS
from snrmjax.identify.joint.free_unknowns import padded_problem, whitened_slopes
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.levenberg_marquardt import inverse_of
from snrmjax.numerics.result import AbstractResult, Variable

Row = TypeVar("Row")


class AbstractTable(AbstractResult, Generic[Row]):
    """A result that is a sequence of rows, each a `NamedTuple`."""

    # Value of a row, unit and meaning.
    columns: ClassVar[Mapping[str, tuple[Callable[[Any], Any], str, str]]]
    rows: tuple[Row, ...]

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Row, ...]: ...
    def __getitem__(self, index: int | slice) -> Row | tuple[Row, ...]:
        """The row at an index, or the rows of a slice."""
        return self.rows[index]

    def __iter__(self) -> Iterator[Row]:
        """The rows in their order."""
        return iter(self.rows)

    def variables(self) -> dict[str, Variable]:
        """One variable per entry of `columns`."""
        return {
            name: Variable(("row",), np.array([of(row) for row in self.rows]), unit, meaning)
            for name, (of, unit, meaning) in self.columns.items()
        }


_LISTED = 8  # sources on one screen
_OTHER = ("stiffness off resonance", "damping off resonance", "modal mass")
_AMPLITUDES = 25  # at which the variance is evaluated


class Contribution(NamedTuple):
    """Contribution of one source of error to the bands of both curves."""

    source: str
    frequency_fraction: float  # of the variance of ω̃, mean over amplitudes
    damping_fraction: float  # of the variance of 2ζ̃ω̃
    kind: str  # of source, such as "gain of levels"


class Contributions(AbstractTable[Contribution]):
    """Fractions of the variance of both bands by source of error, the largest first."""

    coordinates = ("source",)
    columns: ClassVar = {
        "source": (lambda row: row.source, "", "source of error"),
        "kind": (lambda row: row.kind, "", "kind of source"),
        "frequency_fraction": (
            lambda row: row.frequency_fraction,
            *("1", "fraction of the natural frequency's variance"),
        ),
        "damping_fraction": (
            lambda row: row.damping_fraction,
            "1",
            "fraction of the variance of 2ζω",
        ),
    }

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        listed = [
            f"{row.source}: {100 * row.frequency_fraction:.1f} % of the variance of the natural "
            f"frequency, {100 * row.damping_fraction:.1f} % of the damping's"
            for row in self.rows[:_LISTED]
        ]
        more = len(self.rows) - len(listed)
        return (
            f"Contributions: {len(self.rows)} sources of error",
            *listed,
            *((f"and {more} smaller ones",) if more else ()),
        )

    def by_kind(self) -> "Contributions":
        """Contributions summed by kind of source, the largest first.

        >>> gain = Contribution("gain of level 1", 0.2, 0.1, "gain of levels")
        >>> rows = gain, gain._replace(source="gain of level 2")
        >>> Contributions(rows).by_kind()[0][:3]
        ('gain of levels', 0.4, 0.2)
        """
        together = [
            Contribution(
                kind,
                sum(row.frequency_fraction for row in self.rows if row.kind == kind),
                sum(row.damping_fraction for row in self.rows if row.kind == kind),
                kind,
            )
            for kind in dict.fromkeys(row.kind for row in self.rows)
        ]
        together.sort(key=lambda row: -row.frequency_fraction - row.damping_fraction)
        return Contributions(tuple(together))


def _roughness_slopes(fit: JointFit) -> Float[np.ndarray, "row unknown"]:
    """Derivatives of the curves' prior residuals (roughness) by the unknowns."""
    curves = fit.unknowns.squared_frequency, fit.unknowns.modal_damping
    first, second = (jax.tree.map(np.asarray, curve).terms().prior for curve in curves)
    slopes = np.zeros((len(first) + len(second), len(fit.covariance)))
    n = first.shape[1]
    slopes[: len(first), :n], slopes[len(first) :, n : n + second.shape[1]] = first, second
    return slopes


@on_numbers("Differentiate `sj.identify.refit`.")
def contributions(fit: JointFit) -> Contributions:
    """Contributions of noise, level errors and linear parameters to the bands of both curves.

    To first order, as the fit's own covariance: (JᵀJ)⁻¹ = Σ (dθ/dy σ)² over every error y, with
    dθ/dy = −(JᵀJ)⁻¹Jᵀ ∂r/∂y at fixed whitening. Random errors are enlarged where the residuals of
    neighbouring states are correlated.

    Returns fractions of the variance, averaged from the smallest to the largest measured
    displacement, largest first; they sum to one but for rounding.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    n, n_levels = len(fit.data.level), fit.data.n_levels
    points, by_error = whitened_slopes(fit.packed(), padded_problem(fit.problem), n)
    p, n_linear = points.shape[2], len(fit.unknowns.linear)
    deviations = np.eye(p)[-n_linear - n_levels * len(LEVEL_ERRORS) :]
    inverse = inverse_of(
        np.concatenate([points.reshape(-1, p), deviations, _roughness_slopes(fit)])
    )
    by_state = np.einsum("pq,siq,sie->pse", inverse, points, by_error) * np.asarray(fit.data.std)
    measured = np.asarray(fit.motion().displacement)
    at = np.linspace(measured.min(), measured.max(), _AMPLITUDES)
    slopes = values_at_displacement(fit, at).slopes

    rows: list[tuple[str, str, np.ndarray]] = []
    for k, kind in enumerate(STATE_ERRORS):
        if np.any(by_state[:, :, k]):
            name = f"random error of {kind}"
            rows.append((name, name, by_state[:, :, k]))
    linear_std = np.asarray(fit.prior.linear)
    levels = inverse[:, p - n_linear - n_levels * len(LEVEL_ERRORS) : p - n_linear]
    levels = levels.reshape(p, n_levels, len(LEVEL_ERRORS))
    for k, kind in enumerate(LEVEL_ERRORS):
        if np.asarray(fit.prior.level)[k] > 0:
            rows += [
                (f"{kind} of level {number}", f"{kind} of levels", levels[:, m, k : k + 1])
                for m, number in enumerate(fit.level_numbers)
            ]
    for k in range(n_linear):
        column = inverse[:, p - n_linear + k]
        if linear_std[k] > 0:
            name, kind = f"linear parameter {k + 1}", "linear parameters"
            if k >= n_linear - len(_OTHER):
                name = kind = _OTHER[k - n_linear]
            rows.append((name, kind, column[:, None]))
    name = "smoothness of the curves"
    rows.append((name, name, inverse @ _roughness_slopes(fit).T))
    summed = [np.sum((slopes @ columns) ** 2, axis=2) for *_, columns in rows]
    parts = np.stack(summed)
    fractions = np.mean(parts / np.sum(parts, axis=0), axis=1).tolist()
    listed = [
        Contribution(source, fraction[0], fraction[1], kind)
        for (source, kind, _), fraction in zip(rows, fractions, strict=True)
    ]
    ranked = sorted(listed, key=lambda row: -row.frequency_fraction - row.damping_fraction)
    return Contributions(tuple(ranked))
