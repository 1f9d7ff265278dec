"""Which family of curves, of which size and amplitude: the one that predicts left-out levels."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from snrmjax.identify.curves.families import (
    BACKBONE_FAMILIES,
    DAMPING_FAMILIES,
    FAMILIES,
)
from snrmjax.identify.curves.family_base import AbstractFamily, Argument
from snrmjax.identify.curves.splines import SmoothingSpline
from snrmjax.identify.joint.force_balance import LEVEL_ERRORS, BalanceData, Spread, Unknowns
from snrmjax.identify.joint.initial_guess import levels_apart, most_parameters
from snrmjax.identify.joint.linearisation import BalanceSlopes, balance_slopes
from snrmjax.identify.joint.smoothness import (
    curve_columns,
    moved,
    places_of_bends,
    sizes_along,
    with_sizes,
)
from snrmjax.identify.joint.variance_components import (
    Bends,
    Linearised,
    Scatter,
    effective_parameters,
    estimated_scatter,
    left_out_scores,
    level_columns,
    likeliest_std,
    solved,
)
from snrmjax.model.modes import LinearModes

_UNDECIDED = 2.0  # of log predictive density: what a term too many may cost
_DECISIVE = 4.0  # of log predictive density: what no scatter of scores from level to level excuses
_CLEARLY = 20.0  # of −2 log likelihood, to believe in a kind of noise that nobody stated
_ROUNDS = 3  # of choosing families and estimating what levels scatter
_NEGLIGIBLE = 0.03  # weight of a curve that could not widen a band
_CONTENDERS = 4  # of a curve, at most
# Times the likeliest size of bends. With that itself bands hold a curve at 95 of 100 amplitudes,
# but not at each in 95 of 100 tests: where it bends most, smoothing errs about as much as noise.
_UNDERSMOOTHED = 1.5
_SMOOTH = "smoothing_spline"
_STRAIGHT = 1e-7  # of the largest value, a bend that is none
ARGUMENTS: tuple[Argument, ...] = ("displacement", "velocity")


class Candidate(NamedTuple):
    """One family tried, as the table of a report shows it."""

    curve: str  # "backbone" or "damping"
    family: str
    size: int
    argument: str
    parameters: int
    score: float  # log predictive density of left-out levels, relative to the best
    score_std: float  # of the difference to the best, from level to level
    prediction_error: float  # root mean square of left-out residuals over what was foretold
    chosen: bool
    weight: float = 0.0  # among all tried of this curve, by their scores; they sum to one


class Contender(NamedTuple):
    """A curve that was not taken, though the data could mean it."""

    curve: str  # "backbone" or "damping"
    weight: float
    family: AbstractFamily


class Choice(NamedTuple):
    """What the user fixed of a family."""

    kind: str  # or "auto"
    size: int | None
    argument: Argument | None


def parse_family(text: str) -> Choice:
    """Family, size and amplitude of "spline:5@velocity"; what is not said is None.

    Raises `ValueError` for what is no family.
    """
    head, _, argument = text.partition("@")
    kind, _, size = head.partition(":")
    if kind not in FAMILIES and kind != "auto":
        raise ValueError(f"{kind!r} is no family; there are {', '.join(FAMILIES)} and auto.")
    if size and not size.isdigit():
        raise ValueError(f"the size of a family must be a whole number, but is {size!r}.")
    known = {"": None} | {name: name for name in ARGUMENTS}
    if argument not in known:
        raise ValueError(f'the amplitude must be "displacement" or "velocity", not {argument!r}.')
    return Choice(kind, int(size) if size else None, known[argument])


class Selection(NamedTuple):
    """Where the joint fit starts, and the table of what was tried."""

    squared_frequency: AbstractFamily
    modal_damping: AbstractFamily
    scatter: Scatter
    jitter: float  # 1σ of relative stiffness from state to state that no stated noise explains
    table: tuple[Candidate, ...]
    contenders: tuple[Contender, ...]


def select_families(
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    pilot: Unknowns,
    backbone: Choice,
    damping: Choice,
    free: tuple[str, ...],
    *,
    scatter_too: bool,
    smooth: bool = True,
) -> Selection:
    """Try families on the balance linearised at the pilot, and take the simplest good one.

    Levels are left out in turn (every third state where there are fewer than three levels) and
    predicted with their own errors unknown; the score is the log density of what was measured
    there. Of the candidates within one standard error of the best, and not clearly worse, the one
    with the fewest parameters is taken. The pilot's deviations of levels are in their own units;
    states are taken as `data` corrects them. What levels scatter beyond what is stated is looked
    for if `scatter_too`, and how the size of bends changes along a smooth curve: a rough pilot does
    not tell. Without `smooth`, splines with few free knots stand in for smooth ones.
    """
    kinds = [
        tuple("spline" if kind == _SMOOTH and not smooth else kind for kind in those)
        for those in (BACKBONE_FAMILIES, DAMPING_FAMILIES)
    ]

    def workbench(data: BalanceData, at: Unknowns) -> tuple[_Workbench, Scatter, Unknowns]:
        work = _Workbench(data, spread, balance_slopes(at, data, modes, spread), free)
        pair = (at.squared_frequency, at.modal_damping)
        scatter = work.scatter(*pair, look=scatter_too)
        work.use(scatter)
        curves = work.bending(pair, scatter.bends, alike=not scatter_too)
        return work, scatter, _with_curves(at, curves)

    def prepared(at: Unknowns) -> tuple[_Workbench, Scatter, float, Unknowns]:
        work, scatter, found = workbench(data, at)
        jitter = work.jitter(found)
        if jitter > 0:
            wandering = data.std.at[:, 3].set(jitter)
            work, scatter, found = workbench(eqx.tree_at(lambda d: d.std, data, wandering), at)
        return work, scatter, jitter, found

    # What the rough pilot misses looks like levels that differ: its scatter serves to choose
    # families, and theirs to choose again, until both belong together.
    work, scatter, jitter, pilot = prepared(pilot)
    for _ in range(_ROUNDS):
        tried = work.compare("backbone", backbone, kinds[0], pilot.modal_damping)
        other = work.compare("damping", damping, kinds[1], tried.best)
        before = work
        work, scatter, jitter, pilot = prepared(_with_curves(pilot, (tried.best, other.best)))
        if np.array_equal(work.level_std > 0, before.level_std > 0):
            break
    pair = (pilot.squared_frequency, pilot.modal_damping)
    contenders = (*tried.contenders, *other.contenders)
    return Selection(*pair, scatter, jitter, (*tried.table, *other.table), contenders)


_Pair = tuple[AbstractFamily, AbstractFamily]


def _with_curves(unknowns: Unknowns, pair: Sequence[AbstractFamily]) -> Unknowns:
    return eqx.tree_at(lambda u: (u.squared_frequency, u.modal_damping), unknowns, tuple(pair))


def _is_smooth(curve: AbstractFamily) -> bool:
    return isinstance(curve, SmoothingSpline)


def _bent(curve: AbstractFamily, size: float | np.ndarray) -> AbstractFamily:
    return eqx.tree_at(lambda f: f.bend_std, curve, jnp.asarray(size))


def _with_bends(pair: _Pair, sizes: Sequence[float | np.ndarray]) -> list[AbstractFamily]:
    left = iter(sizes)
    return [_bent(curve, next(left)) if _is_smooth(curve) else curve for curve in pair]


class _Compared(NamedTuple):
    best: AbstractFamily
    table: list[Candidate]
    contenders: list[Contender]


def _weights(score: Float[np.ndarray, " family"]) -> Float[np.ndarray, " family"]:
    """How much each family is to be believed, by the log predictive density of what was left out.

    Reference: pseudo-Bayesian averaging, Yao et al., Bayesian Anal. 13 (2018) 917,
    doi:10.1214/17-BA1091.
    """
    known = np.isfinite(score)
    share = np.zeros(len(score))
    share[known] = np.exp(score[known] - np.max(score[known], initial=-np.inf))
    return share / max(np.sum(share), 1.0)


class _Workbench:
    """The linearised balance, on which families are tried one after the other."""

    def __init__(
        self, data: BalanceData, spread: Spread, known: BalanceSlopes, free: tuple[str, ...]
    ):
        self.data, self.known = data, known
        names = ("force_gain", "force_offset", "instrument_phase")
        keep = [k for k, name in enumerate(names) if name in free]
        n_linear = spread.linear.shape[0]
        keep += [3 + k for k in range(n_linear)]
        n = len(data.level)
        self.common = known.by_other[:, :, keep].reshape(2 * n, -1)
        self.common_std = np.concatenate([np.full(len(keep) - n_linear, np.inf), np.ones(n_linear)])
        self.levels = level_columns(known.by_level, np.asarray(data.level), data.n_levels)
        self.stated_std = np.asarray(spread.level)
        self.level_std = self.stated_std.copy()
        self.noise = 1.0
        left_out = np.asarray(data.level)
        if data.n_levels < 3:
            left_out = np.argsort(np.argsort(known.speed)) % 3
        self.folds = [np.repeat(left_out == k, 2) for k in np.unique(left_out)]

    def amplitude(self, argument: Argument) -> np.ndarray:
        return self.known.displacement if argument == "displacement" else self.known.speed

    def problem(self, squared: AbstractFamily, damping: AbstractFamily) -> Linearised:
        """The balance with these curves."""
        n, known = len(self.data.level), self.known
        f, df, f_std = curve_columns(squared, self.amplitude(squared.argument))
        g, dg, g_std = curve_columns(damping, self.amplitude(damping.argument))
        residuals = known.balance + known.by_squared * (f - known.squared)[:, None]
        residuals = residuals + known.by_damping * (g - known.damping)[:, None]
        by_f = (known.by_squared[:, :, None] * df[:, None, :]).reshape(2 * n, -1)
        by_g = (known.by_damping[:, :, None] * dg[:, None, :]).reshape(2 * n, -1)
        slopes = np.concatenate([by_f, by_g, self.common, self.levels], axis=1)
        std = np.concatenate(
            [
                *(f_std, g_std),
                self.common_std,
                np.tile(self.level_std, self.data.n_levels),
            ]
        )
        return Linearised(
            residuals.reshape(-1) / self.noise, slopes / self.noise, std, np.zeros(len(std))
        )

    def scatter(self, squared: AbstractFamily, damping: AbstractFamily, *, look: bool) -> Scatter:
        """What noise and levels say beyond these curves, with nothing but the stated known."""
        problem = self.problem(squared, damping)
        first, n_errors = problem.slopes.shape[1] - self.levels.shape[1], len(LEVEL_ERRORS)
        std = problem.prior_std.copy()
        std[first:] = np.tile(self.stated_std, self.data.n_levels)
        raw = Linearised(
            problem.residuals * self.noise, problem.slopes * self.noise, std, problem.deviation
        )
        index = first + np.arange(self.levels.shape[1]).reshape(-1, n_errors)
        pair = (squared, damping)
        bends = [self.bends(problem, pair, k) for k in range(2) if _is_smooth(pair[k])]
        return estimated_scatter(raw, index, look=look, bends=bends)

    def jitter(self, pilot: Unknowns) -> float:
        """1σ of relative stiffness from state to state, zero unless the residuals ask for it.

        Errors of force and phase move the balance alike along a response; a natural frequency
        that wanders moves it most where the mode is driven hardest.
        """
        problem = self.problem(pilot.squared_frequency, pilot.modal_damping)
        left = (problem.residuals + problem.slopes @ solved(problem)).reshape(-1, 2)
        arm = self.known.by_squared * self.known.squared[:, None] / self.noise
        length = np.sum(arm**2, axis=1)
        along = np.sum(arm * left, axis=1) ** 2
        size = np.sum(left**2, axis=1)

        def criterion(point: np.ndarray) -> float:
            noise, extra = np.exp(2 * point)
            inner = noise + extra * length
            squares = (size - along * extra / inner) / noise
            return float(np.sum(squares + np.log(noise) + np.log(inner)))

        start = np.log([0.5, 0.5 / np.sqrt(np.median(length))])
        found = minimize(criterion, start, method="Nelder-Mead")
        alone = 2 * len(left) * (np.log(np.sum(size) / (2 * len(left))) + 1)
        return float(np.exp(found.x[1])) if found.fun < alone - _CLEARLY else 0.0

    def use(self, scatter: Scatter) -> None:
        self.level_std[:] = scatter.level
        self.noise = scatter.noise

    def improved(
        self, squared: AbstractFamily, damping: AbstractFamily, steps: int
    ) -> tuple[AbstractFamily, AbstractFamily, Linearised]:
        """Gauss–Newton on the linearised balance; exact at once for linear families."""
        for _ in range(steps):
            problem = self.problem(squared, damping)
            change = solved(problem)
            k = squared.parameters.shape[0]
            m = k + damping.parameters.shape[0]
            squared = moved(squared, change[:k])
            damping = moved(damping, change[k:m])
        problem = self.problem(squared, damping)
        return squared, damping, problem

    def smoothed(self, name: str, curve: AbstractFamily, other: AbstractFamily) -> AbstractFamily:
        """A smoothing spline with the likeliest size of its bends; other curves as they are."""
        if not _is_smooth(curve):
            return curve
        pair = (curve, other) if name == "backbone" else (other, curve)
        problem = self.problem(*pair)
        bends = self.bends(problem, pair, 0 if name == "backbone" else 1)
        return _bent(curve, likeliest_std(problem, bends))

    def bending(self, pair: _Pair, sizes: Sequence[float], *, alike: bool) -> list[AbstractFamily]:
        """Curves with bends of the sizes found, of each curve's `alike` or changing along it.

        Those that change are taken larger than likely, so that the curve's bias is small beside
        its noise. Reference: for undersmoothing, Hall, Ann. Stat. 20 (1992) 675,
        doi:10.1214/aos/1176348651.
        """
        curves = _with_bends(pair, sizes)
        smooth = {k: c for k, c in enumerate(pair) if isinstance(c, SmoothingSpline)}
        if alike or not smooth:
            return curves
        problem, seen = self.problem(*curves), (self.known.displacement, self.known.speed)
        bends = [self.bends(problem, pair, k) for k in smooth]
        places = [places_of_bends(curve, *seen) for curve in smooth.values()]
        found = (_UNDERSMOOTHED * size for size in sizes_along(problem, bends, places))
        return [with_sizes(c, next(found)) if isinstance(c, SmoothingSpline) else c for c in pair]

    def bends(self, problem: Linearised, pair: _Pair, which: int) -> Bends:
        """The bends of one of the curves among the unknowns."""
        sizes = [curve.parameters.shape[0] for curve in pair]
        own = sum(sizes[:which]) + np.arange(sizes[which])
        largest = float(np.max(np.abs(np.asarray(pair[which].parameters))))
        return Bends(own[np.isfinite(problem.prior_std[own])], (_STRAIGHT * largest, largest))

    def compare(
        self, name: str, choice: Choice, kinds: tuple[str, ...], other: AbstractFamily
    ) -> _Compared:
        known = self.known
        values = known.squared if name == "backbone" else known.damping
        weight = np.linalg.norm(
            known.by_squared if name == "backbone" else known.by_damping, axis=1
        )
        # Where the pilot's curve was, corrected by what is left: the scattered points themselves.
        rows = []
        arguments = (choice.argument,) if choice.argument else ARGUMENTS
        most = most_parameters(known.speed, self.data.n_levels)
        if name == "damping" and levels_apart(known.speed, np.asarray(self.data.level)):
            # With as many as there are levels, the levels' gains would pass for damping.
            most = min(most, max(self.data.n_levels - 1, 2))
        for kind in kinds if choice.kind == "auto" else (choice.kind,):
            family = FAMILIES[kind]
            sizes_tried = family.sizes(len(values), self.data.n_levels)
            for size in sizes_tried if choice.size is None else (choice.size,):
                for argument in arguments:
                    starts = family.starts(size, argument, self.amplitude(argument), values, weight)
                    if choice.size is not None and starts[0].parameters.shape[0] >= len(values):
                        raise ValueError(
                            f"{kind}:{size} has {starts[0].parameters.shape[0]} parameters, but "
                            f"there are {len(values)} states only: choose a smaller family."
                        )
                    too_many = starts[0].parameters.shape[0] > most
                    if too_many and choice.size is None and (sizes_tried[0] != size):
                        continue
                    rows.append((kind, size, argument, *self._tried(name, starts, other)))
                    if starts[0].parameters.shape[0] == 1 and not choice.argument:
                        break  # a constant has no amplitude
        if not rows:
            raise ValueError(
                f"the {len(values)} states are too few for the {name} asked for: choose a "
                "smaller family."
            )
        scores = np.array([row[4] for row in rows])
        total = scores.sum(axis=1)
        best = int(np.argmax(total))
        apart = scores[best] - scores
        spread = np.sqrt(len(self.folds)) * np.std(apart, axis=1, ddof=1)
        sizes = np.array([row[6] for row in rows])
        # A level that one curve misses by far makes that spread large: it must not excuse it.
        as_good = (total[best] - total) <= np.minimum(spread, _DECISIVE)
        as_good[best] = True
        # Of equally many parameters the one that is listed first, unless another is clearly better:
        # what the noise decides would widen nobody's band.
        least = as_good & (sizes == sizes[as_good].min())
        chosen = int(np.flatnonzero(least & (total >= total[least].max() - _DECISIVE))[0])
        # Bands know a curve's spread, not the bias of a term too few: one more if data allow.
        fair = (total[best] - total) <= 2 * spread + _UNDECIDED
        mine = rows[chosen]
        larger = [
            k
            for k in np.flatnonzero(fair)
            if (rows[k][0], rows[k][2]) == (mine[0], mine[2]) and sizes[k] > sizes[chosen]
        ]
        chosen = int(min(larger, key=lambda k: sizes[k], default=chosen))
        weight = _weights(total)
        table = [
            Candidate(
                curve=name,
                family=row[0],
                size=int(row[1]),
                argument=row[2],
                parameters=int(sizes[k]),
                score=float(total[k] - total[best]),
                score_std=float(spread[k]),
                prediction_error=float(row[5]),
                chosen=k == chosen,
                weight=float(weight[k]),
            )
            for k, row in enumerate(rows)
        ]
        ordered = [k for k in np.argsort(-weight) if k != chosen and weight[k] > _NEGLIGIBLE]
        contenders = [Contender(name, float(weight[k]), rows[k][3]) for k in ordered[:_CONTENDERS]]
        return _Compared(rows[chosen][3], table, contenders)

    def _tried(
        self, name: str, starts: list[AbstractFamily], other: AbstractFamily
    ) -> tuple[AbstractFamily, np.ndarray, float, int]:
        """The best of the improved starts, its score by left-out level, error and parameters."""
        found = []
        for given in starts:
            start = self.smoothed(name, given, other)
            pair = (start, other) if name == "backbone" else (other, start)
            linear = len(starts) == 1
            squared, damping, problem = self.improved(*pair, steps=1 if linear else 4)
            cost = float(problem.residuals @ problem.residuals)
            mine = squared if name == "backbone" else damping
            found.append((cost if np.isfinite(cost) else np.inf, mine, problem))
        _, best, problem = min(found, key=lambda row: row[0])
        first = 0 if name == "backbone" else other.parameters.shape[0]
        own = first + np.arange(best.parameters.shape[0])
        return (
            best,
            *left_out_scores(problem, self.folds),
            int(np.ceil(effective_parameters(problem, own))),
        )
