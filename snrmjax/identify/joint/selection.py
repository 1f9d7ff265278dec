"""Which family of curves, of which size and amplitude: the one that predicts left-out levels."""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple, TypeGuard

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from snrmjax.identify.checks.residual_autocorrelation import (
    along_resonance,
    independent_share,
    residual_autocorrelation,
)
from snrmjax.identify.curves.families import (
    ARGUMENTS,
    BACKBONE_FAMILIES,
    DAMPING_FAMILIES,
    FAMILIES,
    Choice,
)
from snrmjax.identify.curves.family_base import AbstractFamily, Argument
from snrmjax.identify.curves.splines import SmoothingSpline
from snrmjax.identify.joint.force_balance import LEVEL_ERRORS, BalanceData, BalanceProblem, Unknowns
from snrmjax.identify.joint.initial_guess import levels_apart, most_parameters
from snrmjax.identify.joint.ranking import Compared, FamilyCandidate, RivalCurve, Trial, ranked
from snrmjax.identify.joint.residuals import BalanceSlopes, balance_slopes
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
    VarianceComponents,
    effective_parameters,
    estimated_components,
    expected_decrease,
    left_out_scores,
    level_columns,
    likeliest_std,
    solved,
)

_CLEARLY = 20.0  # of −2 log likelihood, to believe in a kind of noise that nobody stated
_ROUNDS = 3  # of choosing families and estimating the level-to-level variance
_FEW = 2  # levels, of which one difference would be left
_OF_INSTRUMENTS = tuple(LEVEL_ERRORS.index(name) for name in ("gain", "phase"))
_ALIKE = 0.1  # relative change of a share of states that ends the search for it
_STEPS = 4  # of Gauss–Newton for a family that is not linear in its parameters
_STILL_FALLING = 0.1  # of χ², by which one step more would lower an unfinished fit
# Times the likeliest size of bends. With that itself bands hold a curve at 95 of 100 amplitudes,
# but not at each in 95 of 100 tests: where it bends most, smoothing errs about as much as noise.
_UNDERSMOOTHED = 1.5
_SMOOTH = "smoothing_spline"
_STRAIGHT = 1e-7  # of the largest value, a bend that is none


class SelectionStatus(IntEnum):
    """How the choice of families and of the level-to-level variance ended."""

    SETTLED = 0
    NOT_SETTLED = 1  # after the last round each still changed the other


class FamilyRequest(NamedTuple):
    """What is asked of both curves, which unknowns are free, and whether noise is stated."""

    backbone: Choice
    damping: Choice
    free: tuple[str, ...]
    stated: bool = True


class Selection(NamedTuple):
    """Where the joint fit starts, and the table of what was tried."""

    squared_frequency: AbstractFamily
    modal_damping: AbstractFamily
    components: VarianceComponents
    jitter: float  # 1σ of relative stiffness from state to state that no stated noise explains
    table: tuple[FamilyCandidate, ...]
    rivals: tuple[RivalCurve, ...]
    status: SelectionStatus


def select_families(
    problem: BalanceProblem,
    guess: Unknowns,
    request: FamilyRequest,
    *,
    components_too: bool,
    smooth: bool = True,
) -> Selection:
    """Try families on the balance linearised at a guess, and take the simplest good one.

    Cross-validation: levels are left out in turn (every third state where there are fewer than
    three levels) and predicted with their own errors unknown; the score is the log density of what
    was measured there. Of the candidates within one standard error of the best, and not clearly
    worse, the one with the fewest parameters is taken. The guess's deviations of levels are in
    their own units; states are taken as the problem corrects them. The level-to-level variance
    beyond what is stated is estimated if `components_too`, and so is how the size of bends changes
    along a smooth curve: the initial guess does not determine them. Noise is then what smooth
    curves leave, by which all families are scored. Without `smooth`, splines with
    few free knots stand in for smoothing splines.
    """
    kinds = [
        tuple("spline" if kind == _SMOOTH and not smooth else kind for kind in those)
        for those in (BACKBONE_FAMILIES, DAMPING_FAMILIES)
    ]

    def scoring(problem: BalanceProblem, at: Unknowns) -> tuple[_Scoring, Unknowns]:
        blank = _Scoring.of(problem, balance_slopes(at, problem), request)
        pair = (at.squared_frequency, at.modal_damping)
        own = blank.with_components(blank.estimated(*pair, look=components_too))
        curves = own.bending(pair, own.components.bends, alike=not components_too)
        return own, _with_curves(at, curves)

    def prepared(at: Unknowns) -> tuple[_Scoring, float, Unknowns]:
        own, found = scoring(problem, at)
        jitter = own.jitter(found)
        if jitter > 0:
            wandering = problem.data.std.at[:, 3].set(jitter)
            own, found = scoring(problem.with_data(std=wandering), at)
        return own, jitter, found

    # What the initial guess misses looks like level-to-level variance: that serves to choose
    # families, and theirs to choose again, until both belong together.
    own, jitter, guess = prepared(guess)
    if components_too and smooth:
        # Noise is what the most flexible curves leave: what stiff ones miss would count as noise
        # and speak for them. Reference: Mallows, Technometrics 15 (1973) 661,
        # doi:10.1080/00401706.1973.10489103.
        pair = [guess.squared_frequency, guess.modal_damping]
        asked = (("backbone", request.backbone), ("damping", request.damping))
        for k, (name, choice) in enumerate(asked):
            if choice.kind == "auto":
                pair[k] = own.compare(name, choice, (_SMOOTH,), pair[1 - k]).best
        own, jitter, guess = prepared(_with_curves(guess, pair))
    status = SelectionStatus.NOT_SETTLED
    for _ in range(_ROUNDS):
        tried = own.compare("backbone", request.backbone, kinds[0], guess.modal_damping)
        other = own.compare("damping", request.damping, kinds[1], tried.best)
        before = own
        own, jitter, guess = prepared(_with_curves(guess, (tried.best, other.best)))
        if np.array_equal(own.level_std > 0, before.level_std > 0):
            status = SelectionStatus.SETTLED
            break
    return Selection(
        squared_frequency=guess.squared_frequency,
        modal_damping=guess.modal_damping,
        components=own.components,
        jitter=jitter,
        table=(*tried.table, *other.table),
        rivals=(*tried.rivals, *other.rivals),
        status=status,
    )


_Pair = tuple[AbstractFamily, AbstractFamily]


def _with_curves(unknowns: Unknowns, pair: Sequence[AbstractFamily]) -> Unknowns:
    return eqx.tree_at(lambda u: (u.squared_frequency, u.modal_damping), unknowns, tuple(pair))


def _is_smooth(curve: AbstractFamily) -> TypeGuard[SmoothingSpline]:
    """Whether a curve has bends of a size to be found: through two knots it has none."""
    return isinstance(curve, SmoothingSpline) and bool(np.size(curve.bends))


def _bent(curve: AbstractFamily, size: float | np.ndarray) -> AbstractFamily:
    return eqx.tree_at(lambda f: f.bend_std, curve, jnp.asarray(size))


def _with_bends(pair: _Pair, sizes: Sequence[float | np.ndarray]) -> list[AbstractFamily]:
    left = iter(sizes)
    return [_bent(curve, next(left)) if _is_smooth(curve) else curve for curve in pair]


class _Scoring(NamedTuple):
    """The linearised balance on which families are tried, with noise and errors of levels."""

    data: BalanceData
    known: BalanceSlopes
    common: Float[np.ndarray, "row unknown"]  # slopes by what is no curve's and no level's
    common_std: Float[np.ndarray, " unknown"]
    levels: Float[np.ndarray, "row unknown"]  # slopes by the levels' errors
    stated_std: Float[np.ndarray, " error"]  # of the levels' errors
    folds: list[np.ndarray]  # rows of every left-out part
    noise_stated: bool
    components: VarianceComponents

    @classmethod
    def of(
        cls, problem: BalanceProblem, known: BalanceSlopes, request: FamilyRequest
    ) -> "_Scoring":
        """With the noise and the errors of levels as stated."""
        data, prior = problem.data, problem.prior
        names = ("force_gain", "force_offset", "instrument_phase")
        keep = [k for k, name in enumerate(names) if name in request.free]
        n_linear = prior.linear.shape[0]
        keep += [3 + k for k in range(n_linear)]
        left_out = np.asarray(data.level)
        if data.n_levels < 3:
            left_out = np.argsort(np.argsort(known.speed)) % 3
        stated = np.asarray(prior.level)
        free_std = np.full(len(keep) - n_linear, np.inf)
        return cls(
            data=data,
            known=known,
            common=known.by_other[:, :, keep].reshape(2 * len(data.level), -1),
            common_std=np.concatenate([free_std, np.ones(n_linear)]),
            levels=level_columns(known.by_level, np.asarray(data.level), data.n_levels),
            stated_std=stated,
            folds=[np.repeat(left_out == k, 2) for k in np.unique(left_out)],
            noise_stated=request.stated,
            components=VarianceComponents(1.0, 0.0, tuple(stated.tolist())),
        )

    def with_components(self, components: VarianceComponents) -> "_Scoring":
        """The same with another noise and other errors of levels."""
        return self._replace(components=components)

    @property
    def level_std(self) -> Float[np.ndarray, " error"]:
        """1σ of the levels' errors."""
        return np.array(self.components.level)

    def amplitude(self, argument: Argument) -> np.ndarray:
        return self.known.displacement if argument == "displacement" else self.known.speed

    def linearised(self, squared: AbstractFamily, damping: AbstractFamily) -> Linearised:
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
        unit = self.components.unit
        return Linearised(residuals.reshape(-1) / unit, slopes / unit, std, np.zeros(len(std)))

    def estimated(
        self, squared: AbstractFamily, damping: AbstractFamily, *, look: bool
    ) -> VarianceComponents:
        """What noise and levels say beyond these curves, with nothing but the stated known.

        Where what is left is larger than the stated noise, or none is stated, and has one sign over
        many states, they count as fewer (`independent_share`): what levels seem to differ by may be
        a law that the curves do not have.
        """
        problem = self.linearised(squared, damping)
        first, n_errors = problem.slopes.shape[1] - self.levels.shape[1], len(LEVEL_ERRORS)
        std = problem.prior_std.copy()
        std[first:] = np.tile(self.stated_std, self.data.n_levels)
        unit = self.components.unit
        raw = Linearised(problem.residuals * unit, problem.slopes * unit, std, problem.deviation)
        index = first + np.arange(self.levels.shape[1]).reshape(-1, n_errors)
        for kind in _OF_INSTRUMENTS if self.data.n_levels > _FEW else ():
            # What all levels have in common tells nothing of how much they differ: it is an error
            # of the whole test, or of the law.
            own = raw.slopes[:, index[:, kind]]
            raw.slopes[:, index[:, kind]] = own - own.mean(axis=1, keepdims=True)
        pair = (squared, damping)
        bends = [self.bends(problem, pair, k) for k in range(2) if _is_smooth(pair[k])]
        found = estimated_components(raw, index, look=look, bends=bends)
        believed = self.noise_stated and not found.contradicts_upward
        if not look or believed:
            return found
        for _ in range(_ROUNDS):
            own = std.copy()
            own[index] = found.level
            for some, size in zip(bends, found.bends, strict=True):
                own[some.places] = size
            independent = self._independent_share(raw, own, found.unit)
            if abs(np.log(independent / found.independent)) < _ALIKE:
                break
            asked = (raw, index)
            found = estimated_components(*asked, bends=bends, independent=independent)
        return found

    def _independent_share(
        self, raw: Linearised, std: Float[np.ndarray, " unknown"], unit: float
    ) -> float:
        """Share of independent states, by what a fit with these 1σ leaves along every level."""
        scaled = Linearised(raw.residuals / unit, raw.slopes / unit, std, raw.deviation)
        left = (scaled.residuals + scaled.slopes @ solved(scaled)).reshape(-1, 2)
        levels = along_resonance(np.asarray(self.data.level), np.asarray(self.data.frequency))
        size = np.sqrt(np.mean(left**2, axis=0))
        return independent_share(residual_autocorrelation(left / size, levels))

    def jitter(self, guess: Unknowns) -> float:
        """1σ of relative stiffness from state to state, zero unless the residuals ask for it.

        Errors of force and phase move the balance alike along a response; a natural frequency
        that wanders moves it most where the mode is driven hardest.
        """
        problem = self.linearised(guess.squared_frequency, guess.modal_damping)
        left = (problem.residuals + problem.slopes @ solved(problem)).reshape(-1, 2)
        arm = self.known.by_squared * self.known.squared[:, None] / self.components.unit
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
        return (
            float(np.exp(found.x[1]))
            if found.fun < alone - _CLEARLY / self.components.independent
            else 0.0
        )

    def improved(
        self, squared: AbstractFamily, damping: AbstractFamily, steps: int
    ) -> tuple[AbstractFamily, AbstractFamily, Linearised]:
        """Gauss–Newton on the linearised balance; exact at once for linear families."""
        for _ in range(steps):
            problem = self.linearised(squared, damping)
            change = solved(problem)
            k = squared.parameters.shape[0]
            m = k + damping.parameters.shape[0]
            squared = moved(squared, change[:k])
            damping = moved(damping, change[k:m])
        problem = self.linearised(squared, damping)
        return squared, damping, problem

    def smoothed(self, name: str, curve: AbstractFamily, other: AbstractFamily) -> AbstractFamily:
        """A smoothing spline with the likeliest size of its bends; other curves as they are."""
        if not _is_smooth(curve):
            return curve
        pair = (curve, other) if name == "backbone" else (other, curve)
        problem = self.linearised(*pair)
        bends = self.bends(problem, pair, 0 if name == "backbone" else 1)
        return _bent(curve, likeliest_std(problem, bends))

    def bending(self, pair: _Pair, sizes: Sequence[float], *, alike: bool) -> list[AbstractFamily]:
        """Curves with bends of the sizes found, of each curve's `alike` or changing along it.

        Those that change are taken larger than likely, so that the curve's bias is small beside
        its noise. Reference: for undersmoothing, Hall, Ann. Stat. 20 (1992) 675,
        doi:10.1214/aos/1176348651.
        """
        curves = _with_bends(pair, sizes)
        smooth = {k: c for k, c in enumerate(pair) if _is_smooth(c)}
        if alike or not smooth:
            return curves
        problem, seen = self.linearised(*curves), (self.known.displacement, self.known.speed)
        bends = [self.bends(problem, pair, k) for k in smooth]
        places = [places_of_bends(curve, *seen) for curve in smooth.values()]
        found = (_UNDERSMOOTHED * size for size in sizes_along(problem, bends, places))
        return [with_sizes(c, next(found)) if _is_smooth(c) else c for c in pair]

    def bends(self, problem: Linearised, pair: _Pair, which: int) -> Bends:
        """The bends of one of the curves among the unknowns."""
        sizes = [curve.parameters.shape[0] for curve in pair]
        own = sum(sizes[:which]) + np.arange(sizes[which])
        largest = float(np.max(np.abs(np.asarray(pair[which].parameters))))
        return Bends(own[np.isfinite(problem.prior_std[own])], (_STRAIGHT * largest, largest))

    def compare(
        self, name: str, choice: Choice, kinds: tuple[str, ...], other: AbstractFamily
    ) -> Compared:
        known = self.known
        values = known.squared if name == "backbone" else known.damping
        weight = np.linalg.norm(
            known.by_squared if name == "backbone" else known.by_damping, axis=1
        )
        # Where the guess's curve was, corrected by what is left: the scattered points themselves.
        trials = []
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
                    trials.append(Trial(kind, size, argument, *self._tried(name, starts, other)))
                    if starts[0].parameters.shape[0] == 1 and not choice.argument:
                        break  # a constant has no amplitude
        if not trials:
            raise ValueError(
                f"the {len(values)} states are too few for the {name} asked for: choose a "
                "smaller family."
            )
        return ranked(name, trials)

    def _tried(
        self, name: str, starts: list[AbstractFamily], other: AbstractFamily
    ) -> tuple[AbstractFamily, np.ndarray, float, int, bool]:
        """The best of the improved starts: the last five fields of a `Trial`."""
        found = []
        for given in starts:
            start = self.smoothed(name, given, other)
            pair = (start, other) if name == "backbone" else (other, start)
            linear = len(starts) == 1
            squared, damping, problem = self.improved(*pair, steps=1 if linear else _STEPS)
            cost = float(problem.residuals @ problem.residuals)
            mine = squared if name == "backbone" else damping
            found.append((cost if np.isfinite(cost) else np.inf, mine, problem))
        _, best, problem = min(found, key=lambda row: row[0])
        first = 0 if name == "backbone" else other.parameters.shape[0]
        own = first + np.arange(best.parameters.shape[0])
        converged = len(starts) == 1 or expected_decrease(problem) < _STILL_FALLING
        return (
            best,
            *left_out_scores(problem, self.folds),
            int(np.ceil(effective_parameters(problem, own))),
            converged,
        )
