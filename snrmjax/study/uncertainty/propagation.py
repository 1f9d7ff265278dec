"""Uncertainty of peaks, folds and resonances, by derivatives and by members, side by side."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.study.uncertainty.followed_motions import ResponseQuantities
from snrmjax.study.uncertainty.moments import (
    ERRORS,
    STATISTICS,
    expanded_members,
    first_order,
    first_order_error,
    monte_carlo,
    normal_members,
    quasi_monte_carlo,
    scatter_limit,
    second_order,
    sobol_members,
)
from snrmjax.study.uncertainty.quantities import (
    MEMBER_MESSAGE,
    AbstractQuantities,
    Expansion,
    MemberStatus,
    SolvedMembers,
)
from snrmjax.study.uncertainty.uncertain_inputs import UncertainInputs

METHODS = ("first_order", "second_order", "monte_carlo", "quasi_monte_carlo")
METHOD_NAMES = ("first order", "second order", "Monte Carlo", "quasi-Monte Carlo")
SAMPLINGS = METHODS[2:]
WRONG = 0.1
"""Error of first order that is worth a note."""
_AGREES = 1e-6  # relative difference of one motion found in two ways


class PropagationSettings(eqx.Module):
    """How many members are solved, and by which seeds."""

    members: int = eqx.field(static=True, default=1024)  # of each sampling
    scramblings: int = eqx.field(static=True, default=8)  # of the Sobol' sequence
    traced: int = eqx.field(static=True, default=32)  # members whose whole curve is traced
    seed: int = eqx.field(static=True, default=0)


DEFAULT_PROPAGATION = PropagationSettings()


class TracedCheck(eqx.Module):
    """Members whose whole response curve was traced, against the motions that were followed."""

    members: int  # that were traced
    agree: Int[np.ndarray, " quantity"]  # the curve has the same event
    differ: Int[np.ndarray, " quantity"]  # another peak is highest, or another number of folds


class Propagation(AbstractResult):
    """Mean, standard deviation and 95 % range of quantities by four methods.

    Members at which a quantity does not exist are left out of its statistics and counted in
    `status_counts`. `first_order_error` compares first order with the solved motions, both of the
    members of quasi-Monte Carlo: its mean in standard deviations, its standard deviation, and the
    farther end of its 95 % range in half widths. `scatter_limit` is the factor on all inputs'
    scatter from which it errs by 10 %, by second order: 1 is the scatter as stated.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("quantity", "approach", "statistic", "sampling")

    inputs: UncertainInputs
    expansion: Expansion  # by standard normal numbers
    statistics: Float[np.ndarray, "method statistic quantity"]
    standard_error: Float[np.ndarray, "sampling statistic quantity"]
    status_counts: Int[np.ndarray, "status quantity"]  # both samplings together, by `MemberStatus`
    first_order_error: Float[np.ndarray, "error quantity"]
    scatter_limit: Float[np.ndarray, "error quantity"]
    members: SolvedMembers  # of quasi-Monte Carlo
    traced: TracedCheck | None  # None where nothing can be traced
    names: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """A line a quantity and method, then what is wrong."""
        n = int(self.status_counts[:, 0].sum())
        lines = [
            f"uncertainty of {len(self.names)} quantities from {len(self.inputs.names)} inputs"
        ]
        for q, name in enumerate(self.names):
            lines.append(f"{name}: {self.expansion.value[q]:.6g} at the nominal inputs")
            for m, method in enumerate(METHOD_NAMES):
                mean, std, lower, upper = self.statistics[m, :, q]
                lines.append(
                    f"  {method}: {mean:.6g} ± {std:.3g} (1σ), 95 % from {lower:.6g} to {upper:.6g}"
                )
        known = self.status_counts[[int(MemberStatus.FOUND), int(MemberStatus.REPLACED)]]
        lines.append(f"members: {n}, found of each quantity at least {known.sum(axis=0).min()}")
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """Statistics by method, their standard errors, counts and limits."""
        both = ("statistic", "quantity")
        kinds = np.array([kind.name.lower() for kind in MemberStatus])
        named = {
            "quantity": Variable(("quantity",), np.array(self.names), "", "quantity"),
            "approach": Variable(("approach",), np.array(METHODS), "", "method"),
            "statistic": Variable(("statistic",), np.array(STATISTICS), "", "statistic"),
            "sampling": Variable(("sampling",), np.array(SAMPLINGS), "", "method with members"),
            "nominal": Variable(("quantity",), self.expansion.value, "SI", "at nominal inputs"),
            "value": Variable(("approach", *both), self.statistics, "SI", "statistic"),
            "standard_error": Variable(
                ("sampling", *both), self.standard_error, "SI", "1σ of the statistic"
            ),
            "status": Variable(("status",), kinds, "", "what became of members"),
            "n_members": Variable(("status", "quantity"), self.status_counts, "1", "members"),
            "error": Variable(("error",), np.array(ERRORS), "", "in which first order errs"),
            "first_order_error": Variable(
                ("error", "quantity"), self.first_order_error, "1", "error of first order"
            ),
            "scatter_limit": Variable(
                ("error", "quantity"), self.scatter_limit, "1", "scatter of a 10 % error"
            ),
        }
        return named

    def attributes(self) -> dict[str, str | float | int]:
        """The notes."""
        return {"notes": "\n".join(self.notes)}


def propagate_uncertainty(
    quantities: AbstractQuantities, settings: PropagationSettings = DEFAULT_PROPAGATION
) -> Propagation:
    """Uncertainty of quantities from that of their inputs, by four methods side by side.

    With f(z) the quantity by independent standard normal numbers, g its gradient and H its Hessian
    at the nominal inputs z = 0 (automatic differentiation): first order is f(0) with variance gᵀg;
    second order f(0) + ½ tr H with variance gᵀg + ½ tr H² and the percentage points of the
    quadratic; Monte Carlo and quasi-Monte Carlo (scrambled Sobol' sequences) solve members.
    Notes name the quantities of which first order is wrong by more than a tenth, and of which
    members do not exist.

    Arguments: `quantities` by `response_quantities`, or `FunctionQuantities` of your own function.
    Returns a `Propagation`. Raises `ValueError` for fewer than 64 members and for members
    that the scramblings do not divide into powers of two.
    Validity: the derivatives know nothing of what happens away from the nominal inputs; where
    members cease to exist (folds that merge) no method's range covers that, and the note says so.
    Reference: for the derivatives Anderson, J. Aircraft 36 (1999) and Putko et al., J. Fluids
    Eng. 124 (2002) 60, doi:10.1115/1.1446068; scramblings: Owen, J. Complexity 14 (1998) 466,
    doi:10.1006/jcom.1998.0487.

    >>> from snrmjax.study.uncertainty.quantities import FunctionQuantities
    >>> from snrmjax.study.uncertainty.uncertain_inputs import correlated_inputs
    >>> inputs = correlated_inputs(["x"], [1.0], [[0.04]])
    >>> found = propagate_uncertainty(FunctionQuantities(lambda x: x**2, inputs, ("y",), ("",)))
    >>> found.statistics[:2, 0, 0].round(6).tolist()
    [1.0, 1.04]
    """
    per_scrambling = _members_per_scrambling(settings)
    n_inputs = len(quantities.inputs.names)
    expansion = quantities.expansion()
    random_z = normal_members(settings.members, n_inputs, settings.seed)
    sobol_z = sobol_members(per_scrambling, n_inputs, settings.scramblings, settings.seed)
    sampled = quantities.members(random_z)
    spread = quantities.members(sobol_z.reshape(-1, n_inputs))
    by_scrambling = spread.values.reshape(settings.scramblings, per_scrambling, -1)
    solved = [monte_carlo(sampled.values), quasi_monte_carlo(by_scrambling)]
    final = [one.statistics for one in solved]
    first, second = first_order(expansion), second_order(expansion)
    # Of the same members, so that the sequence's own error does not count.
    linear, quadratic = (
        quasi_monte_carlo(one.reshape(by_scrambling.shape)).statistics
        for one in expanded_members(expansion, sobol_z.reshape(-1, n_inputs))
    )
    error = first_order_error(linear, final[1])
    rest = first_order_error(quadratic, final[1])
    status = np.concatenate([sampled.status, spread.status])
    counts = np.stack([np.sum(status == int(kind), axis=0) for kind in MemberStatus])
    limit = scatter_limit(expansion)
    traced = _traced(quantities, random_z[: settings.traced], sampled)
    names = tuple(quantities.names)
    notes = [
        *getattr(quantities, "notes", ()),
        *_accuracy_notes(names, (error, rest), limit, linear, final[1]),
        *_member_notes(names, counts),
        *_traced_notes(names, traced),
    ]
    return Propagation(
        inputs=quantities.inputs,
        expansion=expansion,
        statistics=np.stack([first, second, *final]),
        standard_error=np.stack([one.standard_error for one in solved]),
        status_counts=counts,
        first_order_error=error,
        scatter_limit=limit,
        members=spread,
        traced=traced,
        names=names,
        notes=tuple(notes),
    )


def _members_per_scrambling(settings: PropagationSettings) -> int:
    """How many members each scrambling has. Raises `ValueError` where it is no power of two."""
    each, rest = divmod(settings.members, settings.scramblings)
    if settings.members < 64 or settings.scramblings < 2 or rest or each & (each - 1):
        raise ValueError(
            "`members` must be 64 or more and `scramblings` times a power of two, two or more"
            f" scramblings, but there are {settings.members} members in {settings.scramblings}."
        )
    return each


def _traced(
    quantities: AbstractQuantities, z: np.ndarray, found: SolvedMembers
) -> TracedCheck | None:
    """The first members once more, from their whole curves."""
    if not isinstance(quantities, ResponseQuantities):
        return None
    possible = np.flatnonzero(quantities.inputs.possible(z)) if len(z) else np.zeros(0, int)
    if not possible.size:
        return None
    whole, known = quantities.traced(z[possible])
    followed = found.values[possible][known]
    whole = whole[known]
    same = np.isclose(whole, followed, rtol=_AGREES, atol=0, equal_nan=True)
    # A frequency and a velocity belong to one event.
    same = np.repeat(same[:, 0::2] & same[:, 1::2], 2, axis=1)
    return TracedCheck(int(known.sum()), same.sum(axis=0), (~same).sum(axis=0))


def _accuracy_notes(
    names: tuple[str, ...],
    errors: tuple[np.ndarray, np.ndarray],
    limit: np.ndarray,
    first: np.ndarray,
    members: np.ndarray,
) -> list[str]:
    notes, (error, of_second) = [], errors
    for q, name in enumerate(names):
        worst = int(np.nanargmax(error[:, q])) if np.any(np.isfinite(error[:, q])) else 0
        if not error[worst, q] > WRONG:
            continue
        what = {
            "mean": f"the mean is off by {error[0, q]:.2g} standard deviations",
            "std": f"the standard deviation is {first[1, q]:.3g}, that of the members"
            f" {members[1, q]:.3g}",
            "range": f"its 95 % range is {first[2, q]:.6g} to {first[3, q]:.6g}, that of the"
            f" members {members[2, q]:.6g} to {members[3, q]:.6g}",
        }[ERRORS[worst]]
        notes.append(
            f"first order is wrong for {name} by {100 * error[worst, q]:.0f} % ({what}); second"
            f" order errs by {100 * of_second[:, q].max():.0f} %; by second order, first order errs"
            f" by 10 % from {limit[:, q].min():.2g} times this scatter on"
        )
    return notes


def _member_notes(names: tuple[str, ...], counts: np.ndarray) -> list[str]:
    notes, n = [], int(counts[:, 0].sum())
    for kind in tuple(MemberStatus)[1:]:
        groups: dict[int, list[str]] = {}
        for name, count in zip(names, counts[int(kind)].tolist(), strict=True):
            if count:
                groups.setdefault(count, []).append(name)
        replaced = kind == MemberStatus.REPLACED
        rest = "" if replaced else "; the statistics are those of the others"
        for count, own in groups.items():
            notes.append(
                f"{count} of {n} members ({100 * count / n:.2g} %) have {MEMBER_MESSAGE[kind]}:"
                f" {', '.join(own)}{rest}"
            )
    return notes


def _traced_notes(names: tuple[str, ...], traced: TracedCheck | None) -> list[str]:
    if traced is None:
        return []
    return [
        f"of {traced.members} members traced as whole curves {count} have another event in place"
        f" of {name.removesuffix('_frequency_hz')}: another one is the highest, or the number of"
        " folds differs; the motion that is followed is not the one that a test would find there"
        for name, count in zip(names, traced.differ.tolist(), strict=True)
        if count and name.endswith("_frequency_hz")
    ]
