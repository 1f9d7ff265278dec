"""The answer by parts: laws of stiffness and damping, their fraction, and the remainder."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.kinds.registry import hypothesis_of
from snrmjax.diagnose.naming.assessed import DRAWN, Assessed, Laws, classes_of
from snrmjax.diagnose.naming.columns import parameters_of
from snrmjax.diagnose.naming.rows import Cell, Problem, Solved, solved

_CELLS = 100  # hypotheses that are solved, about
_LEAST = 1e-3  # probability of laws of which at least one hypothesis is solved
_NOT_NOISE = float(np.log(priors.NAMED / (1 - priors.NAMED)))  # ln odds of `NAMED`
_DRAWS = 500  # samples of the explained fraction
_POINTS = 60  # of a drawn remainder


class Explained(NamedTuple):
    """Fraction of a part's change explained by laws, with its 95 % band."""

    value: float
    low: float
    high: float

    def is_most(self, *, rest_is_noise: bool) -> bool:
        """Whether it is most of the change, with weaker limits if the rest may be noise."""
        if rest_is_noise:
            return self.value >= priors.AT_LEAST and self.high >= priors.EXPLAINED
        return self.value >= priors.EXPLAINED and self.low >= priors.AT_LEAST


class Remainder(NamedTuple):
    """The remainder of a part: a curve of amplitude."""

    velocity: Float[np.ndarray, " point"]  # m/s, of the mode at its natural frequency
    value: Float[np.ndarray, " point"]  # relative, of ω₀² or of 2ω₀²; of a harmonic in m/s
    laws: Float[np.ndarray, " point"]  # contribution of the laws, likewise
    std: Float[np.ndarray, " point"]
    state_velocity: Float[np.ndarray, " state"]  # m/s, likewise
    # Whole change of each state, about the estimated linear mode.
    state_change: Float[np.ndarray, " state"]
    rms: float  # over the measured states
    significant: bool  # more probable than not


class PartAnswer(NamedTuple):
    """The answer for one part of the test."""

    part: str
    verdict: str  # none, named, ambiguous, drawn
    effects: Laws
    candidates: tuple[Laws, ...]  # of every effect: itself, and its alternatives
    probability: float  # of the effects or their candidates
    explained: Explained | None
    remainder: Remainder | None


class Strength(NamedTuple):
    """One parameter of an effect in modal units, and its 1σ."""

    value: float
    std: float


class Naming(NamedTuple):
    """The whole answer."""

    parts: tuple[PartAnswer, ...]
    answers: Mapping[Laws, float]  # probabilities of sets of laws, the most probable first
    parameters: Mapping[str, Strength]  # in the most probable hypothesis with all laws
    misfit: float  # root-mean-square residual of that hypothesis, over the noise
    of_fundamentals: float  # that of the fundamentals alone
    cell: Cell
    natural_frequency: float  # rad/s, of the linear mode in that hypothesis
    damping_ratio: float

    @property
    def effects(self) -> Laws:
        """The first of each class of each part, without duplicates."""
        return tuple(dict.fromkeys(kind for part in self.parts for kind in part.effects))

    @property
    def candidates(self) -> tuple[Laws, ...]:
        """For every effect itself and its alternatives in any part."""
        classes: dict[str, Laws] = {}
        for part in self.parts:
            for group in part.candidates:
                classes[group[0]] = tuple(dict.fromkeys((*classes.get(group[0], ()), *group)))
        return tuple(classes[kind] for kind in self.effects)


_Negligible = tuple[np.ndarray, Callable[[np.ndarray], bool]]


def naming_of(problem: Problem, cells: list[Cell]) -> Naming:
    """The answer by parts from the hypotheses of a test's readings."""
    negligible = {part: _negligible(problem, part) for part in problem.parts}
    assessed = [
        _assessed(problem, cell, weight, negligible)
        for cell, weight in _representative(problem, cells)
    ]
    classes = {part: classes_of(assessed, part) for part in (*problem.parts, "instrument")}
    wanted = {kind for effects, _, _ in classes.values() for kind in effects}
    with_all = [
        one for one in assessed if wanted <= {k for some in one.laws.values() for k in some}
    ]
    # Laws that are not named would be missing in the completed model.
    no_other = [
        one for one in with_all if wanted >= {problem.columns[c].kind for c in one.cell.columns}
    ]
    best = max(no_other or with_all or assessed, key=lambda one: one.weight)
    parts = [_part(problem, assessed, part, best, classes[part]) for part in classes]
    nothing = sum(one.weight for one in assessed if one.changes_nothing)
    if nothing < 0.5 and all(part.verdict == "none" for part in parts):
        # A probable instrument error, or a change of which no part alone is probable.
        k = -1 if parts[-1].effects else int(np.argmin([part.probability for part in parts[:-1]]))
        parts[k] = parts[k]._replace(verdict="drawn")
    answers: dict[Laws, float] = {}
    for one in assessed:
        laws = _answer(one, parts)
        answers[laws] = answers.get(laws, 0.0) + one.weight
    answers = dict(sorted(answers.items(), key=lambda pair: -pair[1]))
    linear, (stiffness_error, damping_error) = problem.readings.linear, best.solved.linear
    return Naming(
        tuple(parts),
        answers,
        _parameters(problem, best, wanted),
        best.solved.misfit,
        of_fundamentals=best.solved.of_fundamentals,
        cell=best.cell,
        natural_frequency=linear.natural_frequency + stiffness_error * linear.frequency_std,
        damping_ratio=linear.damping_ratio + damping_error * linear.damping_std,
    )


def _representative(problem: Problem, cells: list[Cell]) -> list[tuple[Cell, float]]:
    """Hypotheses to be solved, with probabilities that include those that are left out.

    Laws with several shape parameters spread over many shapes, each of small probability. So each
    set of laws keeps its probability, whatever the number of its shapes that are solved.
    """
    weight = np.exp([cell.log_evidence - cells[0].log_evidence for cell in cells])
    weight = weight / weight.sum()
    groups: dict[Any, list[int]] = {}
    for k, cell in enumerate(cells):
        kinds = tuple(sorted(problem.columns[c].kind for c in cell.columns))
        groups.setdefault((kinds, *(std > 0 for std in cell.remainder_std)), []).append(k)
    chosen = []
    for group in groups.values():
        whole = float(weight[group].sum())
        if whole > _LEAST:
            some = group[: max(1, round(_CELLS * whole))]
            part = weight[some] * (whole / weight[some].sum())
            chosen += [(cells[k], float(w)) for k, w in zip(some, part, strict=True)]
    total = sum(w for _, w in chosen)
    return sorted([(cell, w / total) for cell, w in chosen], key=lambda pair: -pair[1])


def _answer(one: Assessed, parts: list[PartAnswer]) -> Laws:
    """The laws of a hypothesis, and drawn remainders of parts that it does not name by a law."""
    named = {part.part for part in parts if part.verdict in ("named", "ambiguous")}
    laws = {law for of_part in one.laws.values() for law in of_part}
    for part, kind in DRAWN.items():
        if one.left[part] and not (part in named and one.laws[part]):
            laws.add(kind)
    return tuple(sorted(laws))


def _parameters(problem: Problem, one: Assessed, wanted: set[str]) -> dict[str, Strength]:
    """Parameters of a hypothesis' laws, with 1σ from the strengths alone."""
    parameters: dict[str, Strength] = {}
    std = np.sqrt(np.diag(one.solved.covariance))
    for index, k in enumerate(one.cell.columns):
        column, strength = problem.columns[k], float(one.solved.mean[index])
        if column.kind not in wanted:
            continue
        values = parameters_of(problem.readings, column, strength) or {}
        shifted = parameters_of(problem.readings, column, strength + float(std[index])) or {}
        for name, value in values.items():
            label = f"{column.kind}.{name}"
            if value or label not in parameters:  # force harmonics: one nonzero value a column
                parameters[label] = Strength(value, abs(shifted[name] - value))
    return parameters


class _Changes(NamedTuple):
    """Changes of a part at every state, over ω₀²; complex for harmonics."""

    of_law: np.ndarray  # (state, law)
    functions: np.ndarray  # (state, function), basis of the remainder
    strength: np.ndarray
    rest: np.ndarray  # coefficients of the remainder's functions
    covariance: np.ndarray  # of these

    @property
    def left(self) -> np.ndarray:
        """The remainder."""
        return self.functions @ self.rest


def _std_along(functions: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("si,ij,sj->s", functions, covariance, functions.conj()).real)


def _changes(problem: Problem, cell: Cell, solution: Solved, part: str) -> _Changes:
    readings, k = problem.readings, len(cell.columns)
    columns = [problem.columns[c] for c in cell.columns]
    functions = problem.functions[part]
    if part == "stiffness":
        changes = [column.change.real for column in columns]
    elif part == "damping":
        changes = [column.change.imag / readings.relative_frequency for column in columns]
    else:
        changes = [column.higher[problem.parts.index(part) - 2] for column in columns]
    some = _rest(problem, cell, part)
    laws = np.array(changes).reshape(k, len(functions)).T
    covariance = solution.covariance[some, some]
    return _Changes(laws, functions, solution.mean[:k], solution.mean[some], covariance)


def _rest(problem: Problem, cell: Cell, part: str) -> slice:
    """Slice of a part's remainder among a hypothesis' unknowns."""
    each = [functions.shape[1] for functions in problem.functions.values()]
    k = problem.parts.index(part)
    first = len(cell.columns) + sum(each[:k])
    return slice(first, first + each[k])


def _assessed(
    problem: Problem, cell: Cell, weight: float, negligible: dict[str, _Negligible]
) -> Assessed:
    solution = solved(problem, cell)
    k = len(cell.columns)
    std = np.sqrt(np.diag(solution.covariance))[:k]
    visible_laws = np.abs(solution.mean[:k]) > priors.VISIBLE * std
    laws: dict[str, Laws] = {"instrument": ()}
    left = {"instrument": False}
    damping = _changes(problem, cell, solution, "damping")
    damped = 2 * problem.readings.damping_ratio + damping.of_law @ damping.strength + damping.left
    for part in problem.parts:
        small, visible = negligible[part]
        if part in DRAWN:
            small = small * np.abs(damped)
        change = _changes(problem, cell, solution, part)
        rest, each = change.left, change.of_law * change.strength
        whole = _rms(np.sum(each, axis=1) + rest)
        odds = log_odds_of_remainder(problem, cell, solution, part)
        significant = odds > _NOT_NOISE and visible(rest)
        left[part] = bool(significant and np.max(np.abs(rest) / small) > 1)
        kinds = []
        for index, column in enumerate(cell.columns):
            own = each[:, index]
            matters = _rms(own) > priors.NEGLIGIBLE * whole and np.max(np.abs(own) / small) > 1
            if visible_laws[index] and matters and visible(own):
                kinds.append(problem.columns[column].kind)
        laws[part] = tuple(sorted(kind for kind in kinds if not hypothesis_of(kind).of_instrument))
        if part.startswith("harmonic"):  # instrument kinds (exciter harmonics) count here
            laws[part] = tuple(sorted(kinds))
    laws["instrument"] = tuple(
        sorted(
            {
                problem.columns[c].kind
                for index, c in enumerate(cell.columns)
                if visible_laws[index] and hypothesis_of(problem.columns[c].kind).of_instrument
            }
        )
    )
    return Assessed(weight, cell, solution, laws, left)


def log_odds_of_remainder(problem: Problem, cell: Cell, solution: Solved, part: str) -> float:
    """ln Bayes factor of a part's remainder against none.

    Savage–Dickey ratio, prior over posterior density at zero remainder: Dickey, Ann. Math. Stat.
    42 (1971) 204, doi:10.1214/aoms/1177693507.
    """
    std, some = cell.remainder_std[problem.parts.index(part)], _rest(problem, cell, part)
    if std == 0:
        return -np.inf
    mean, covariance = solution.mean[some], solution.covariance[some, some]
    _, log_det = np.linalg.slogdet(covariance / std**2)
    return 0.5 * float(log_det + mean @ np.linalg.solve(covariance, mean))


def _negligible(problem: Problem, part: str) -> _Negligible:
    """Largest negligible change at every state, and a test whether the rows resolve a change.

    For stiffness and damping relative to the damping δ/ω₀.
    """
    if part in DRAWN:
        return np.full(len(problem.functions[part]), priors.BELOW_BANDWIDTH), lambda _: True
    one = problem.readings.harmonics[problem.parts.index(part) - 2]
    unit = problem.readings.natural_frequency**2

    def shown(change: np.ndarray) -> bool:
        return bool(np.linalg.norm(one.whitened(unit * change)) > priors.VISIBLE + 1)

    return np.full(len(one.weight), 1e-12), shown


def _rms(values: np.ndarray) -> float:
    """Root-mean-square over the states."""
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


def _part(
    problem: Problem,
    assessed: list[Assessed],
    part: str,
    best: Assessed,
    answer: tuple[Laws, tuple[Laws, ...], float],
) -> PartAnswer:
    """The answer for a part, from the probabilities of laws over all hypotheses."""
    effects, candidates, probability = answer
    none = sum(one.weight for one in assessed if not one.laws[part])
    alternatives = {law for group in candidates for law in group}
    unchanged = sum(
        one.weight
        for one in assessed
        if not (one.laws[part] or one.left[part] or alternatives & {*one.instead(part)})
    )
    if part == "instrument":
        verdict = "none"
        if probability >= priors.NAMED:
            verdict = "named" if all(len(group) == 1 for group in candidates) else "ambiguous"
        return PartAnswer(part, verdict, effects, candidates, max(probability, none), None, None)
    explained = _explained(problem, assessed, part, candidates) if effects else None
    remainder = _remainder(problem, assessed, part, best)
    if unchanged >= 0.5:
        verdict, effects, candidates, probability, explained = "none", (), (), unchanged, None
    elif not effects:
        verdict, probability = "drawn", none
    elif (
        probability >= priors.NAMED
        and explained is not None
        and explained.is_most(rest_is_noise=not remainder.significant)
    ):
        single = all(len(group) == 1 for group in candidates)
        verdict = "named" if single else "ambiguous"
    else:
        verdict = "drawn"
    return PartAnswer(part, verdict, effects, candidates, probability, explained, remainder)


def _explained(
    problem: Problem, assessed: list[Assessed], part: str, candidates: tuple[Laws, ...]
) -> Explained:
    """The fraction of a part's change explained by its laws, by posterior sampling."""
    named = {law for group in candidates for law in group}
    rng = np.random.default_rng(0)
    weights = np.array([one.weight for one in assessed])
    has = np.array([bool(named & {*one.laws[part]}) for one in assessed])
    weights = weights * has / np.sum(weights * has)
    fractions = []
    drawn, counts = np.unique(rng.choice(len(assessed), _DRAWS, p=weights), return_counts=True)
    for one, times in zip([assessed[k] for k in drawn], counts.tolist(), strict=True):
        change = _changes(problem, one.cell, one.solved, part)
        draws = rng.multivariate_normal(
            one.solved.mean, one.solved.covariance, size=times, method="eigh"
        )
        n_laws = len(one.cell.columns)
        kinds = [problem.columns[c].kind for c in one.cell.columns]
        own = np.array([kind in named for kind in kinds])
        # What an instrument error does is no change of the structure, unless it is an alternative.
        further = np.array([not hypothesis_of(kind).of_instrument for kind in kinds]) & ~own
        law = (draws[:, :n_laws] * own) @ change.of_law.T
        other = (draws[:, :n_laws] * further) @ change.of_law.T
        rest = draws[:, _rest(problem, one.cell, part)] @ change.functions.T + other
        spread = _rms_of if part not in DRAWN or _is_flat(law) else _std_of
        # Uncertainty along the law's own curve: its describing function, and remainder like it.
        error = np.hypot(priors.DESCRIBED * spread(law), priors.ALONG * spread(rest))
        error = error / np.maximum(spread(law), 1e-300) * rng.standard_normal(times)
        law, rest = law * (1 + error[:, None]), rest - law * error[:, None]
        fractions.append(1 - spread(rest) / np.maximum(spread(law + rest), 1e-300))
    every = np.clip(np.concatenate(fractions), 0.0, 1.0)
    return Explained(float(np.median(every)), *np.quantile(every, [0.025, 0.975]).tolist())


def _is_flat(curves: np.ndarray) -> bool:
    """Whether laws change a part by constants: then their rms counts, not their variation."""
    return bool(np.median(_std_of(curves)) < 0.1 * np.median(_rms_of(curves)))


def _std_of(curves: np.ndarray) -> np.ndarray:
    return np.std(curves, axis=1)


def _rms_of(curves: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.abs(curves) ** 2, axis=1))


def _remainder(problem: Problem, assessed: list[Assessed], part: str, best: Assessed) -> Remainder:
    readings = problem.readings
    x = np.geomspace(np.min(readings.relative_amplitude), 1.0, _POINTS)
    natural = readings.natural_frequency
    velocity = x * np.max(readings.amplitude) * natural
    change = _changes(problem, best.cell, best.solved, part)
    functions = problem.remainders(part, x)
    order = np.argsort(readings.relative_amplitude)
    # Instrument errors are no curves of amplitude: states are corrected for them instead.
    kinds = [problem.columns[c].kind for c in best.cell.columns]
    erring = np.array(
        [part in DRAWN and hypothesis_of(kind).of_instrument for kind in kinds], dtype=bool
    )
    at_states = change.of_law @ (change.strength * ~erring)
    laws = np.interp(x, readings.relative_amplitude[order], at_states[order])
    if part in DRAWN:
        unit: Any = 1.0 if part == "stiffness" else 0.5
        unit_of_state = unit
        # Errors of the linear test are no change with amplitude: subtract them.
        stiffness_error, damping_error = best.solved.linear
        beyond = np.real(readings.beyond) / natural**2
        beyond = beyond - 2 * stiffness_error * readings.linear.frequency_std / natural
        if part == "damping":
            beyond = np.imag(readings.beyond) / (2 * natural * readings.frequency)
            beyond = beyond - damping_error * readings.linear.damping_std
        beyond = beyond - unit * (change.of_law @ (change.strength * erring))
        std = _std_along(functions, change.covariance)
        value = functions @ change.rest
    else:  # magnitudes of the velocity at the sensor
        one = readings.harmonics[problem.parts.index(part) - 2]
        unit = velocity * one.order / (one.order**2 - 1)
        unit_of_state = readings.amplitude * natural * one.order / (one.order**2 - 1)
        beyond = np.where(one.weight > 0, np.abs(one.beyond) / natural**2, np.nan) * unit_of_state
        std = _std_along(functions, change.covariance)
        value = np.abs(laws + functions @ change.rest) - np.abs(laws)
        laws = np.abs(laws)
    probability = sum(one.weight for one in assessed if one.left[part])
    return Remainder(
        velocity,
        unit * value,
        unit * laws,
        unit * std,
        readings.amplitude * natural,
        beyond,
        rms=_rms(unit_of_state * change.left),
        significant=probability > 0.5,
    )
