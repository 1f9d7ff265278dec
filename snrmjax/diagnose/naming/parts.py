"""The answer by parts: laws that change stiffness and damping, their fraction, what is left."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming.columns import is_instrument, parameters_of
from snrmjax.diagnose.naming.rows import Cell, Problem, Solved, solved
from snrmjax.model.library.free_laws import DisplacementDampingLaw, StiffnessLaw

DRAWN = {"stiffness": StiffnessLaw.kind, "damping": DisplacementDampingLaw.kind}
"""The law that a remainder of a part is."""
_CELLS = 100  # most probable hypotheses whose strengths are solved for
_NOT_NOISE = float(np.log(priors.NAMED / (1 - priors.NAMED)))  # of ln odds, as a law's name asks
_DRAWS = 500  # of fractions
_POINTS = 60  # of a drawn remainder

Laws = tuple[str, ...]


class Explained(NamedTuple):
    """Fraction of a part's change that laws account for, and its 95 % band."""

    value: float
    low: float
    high: float

    def is_most(self, *, rest_is_noise: bool) -> bool:
        """Whether it is most of the change; if the rest may be noise, half and perhaps most."""
        if rest_is_noise:
            return self.value >= priors.AT_LEAST and self.high >= priors.EXPLAINED
        return self.value >= priors.EXPLAINED and self.low >= priors.AT_LEAST


class Remainder(NamedTuple):
    """What is left of a part: a curve of amplitude."""

    velocity: Float[np.ndarray, " point"]  # m/s, of the mode at its natural frequency
    value: Float[np.ndarray, " point"]  # relative, of ω₀² or of 2ω₀²; of a harmonic in m/s
    laws: Float[np.ndarray, " point"]  # what the laws add, alike
    std: Float[np.ndarray, " point"]
    state_velocity: Float[np.ndarray, " state"]  # m/s, alike
    # What each state reads of the whole change, with the linear mode that was found.
    state_change: Float[np.ndarray, " state"]
    rms: float  # over the measured states
    significant: bool  # beyond what noise can be


class PartAnswer(NamedTuple):
    """What one part of the test shows beyond the model."""

    part: str
    verdict: str  # none, named, ambiguous, drawn
    effects: Laws
    candidates: tuple[Laws, ...]  # of every effect: itself, and what may stand in its place
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
    answers: Mapping[Laws, float]  # probabilities of sets of laws, the likeliest first
    parameters: Mapping[str, Strength]  # of the laws in the most probable hypothesis with them all
    misfit: float  # root-mean-square residual of that hypothesis, over the noise
    of_fundamentals: float  # that of the fundamentals alone
    cell: Cell
    natural_frequency: float  # rad/s, of the linear mode in that hypothesis
    damping_ratio: float

    @property
    def effects(self) -> Laws:
        """The first of every class of every part, each once."""
        return tuple(dict.fromkeys(kind for part in self.parts for kind in part.effects))

    @property
    def candidates(self) -> tuple[Laws, ...]:
        """Of every effect all that may stand in its place in any part."""
        found: dict[str, Laws] = {}
        for part in self.parts:
            for group in part.candidates:
                found[group[0]] = tuple(dict.fromkeys((*found.get(group[0], ()), *group)))
        return tuple(found[kind] for kind in self.effects)


_Least = tuple[np.ndarray, Callable[[np.ndarray], bool]]


class _Read(NamedTuple):
    """One hypothesis, with what it says of every part."""

    weight: float
    cell: Cell
    solved: Solved
    laws: dict[str, Laws]  # that are seen, by part
    left: dict[str, bool]  # whether a remainder is seen

    @property
    def drawn(self) -> bool:
        """Whether a remainder is seen in any part."""
        return any(self.left.values())

    def instead(self, part: str) -> Laws:
        """Instruments' errors with which a part shows neither a law nor a remainder."""
        return () if self.laws[part] or self.left[part] else self.laws["instrument"]


def naming_of(problem: Problem, cells: list[Cell]) -> Naming:
    """What explains most of a test's readings."""
    cells = cells[:_CELLS]
    weight = np.exp([cell.log_evidence - cells[0].log_evidence for cell in cells])
    weight = weight / weight.sum()
    least = {part: _smallest(problem, part) for part in problem.parts}
    reads = [_read(problem, cell, float(w), least) for cell, w in zip(cells, weight, strict=True)]
    answers: dict[Laws, float] = {}
    for one in reads:
        drawn = (kind for part, kind in DRAWN.items() if one.left[part])
        laws = tuple(sorted({*drawn, *(law for part in one.laws.values() for law in part)}))
        answers[laws] = answers.get(laws, 0.0) + one.weight
    answers = dict(sorted(answers.items(), key=lambda pair: -pair[1]))
    classes = {part: _classes(reads, part) for part in (*problem.parts, "instrument")}
    wanted = {kind for effects, _, _ in classes.values() for kind in effects}
    with_all = [one for one in reads if wanted <= {k for some in one.laws.values() for k in some}]
    best = max(with_all or reads, key=lambda one: one.weight)
    parts = [_part(problem, reads, part, best, classes[part]) for part in classes]
    nothing = sum(one.weight for one in reads if not (any(one.laws.values()) or one.drawn))
    if nothing < 0.5 and all(part.verdict == "none" for part in parts):
        # Something is there: an instrument's error that is not certain, or no part has half of it.
        k = -1 if parts[-1].effects else int(np.argmin([part.probability for part in parts[:-1]]))
        parts[k] = parts[k]._replace(verdict="drawn")
    linear, (softer, lossier) = problem.readings.linear, best.solved.linear
    return Naming(
        *(tuple(parts), answers, _parameters(problem, best, wanted), best.solved.misfit),
        of_fundamentals=best.solved.of_fundamentals,
        cell=best.cell,
        natural_frequency=linear.natural_frequency + softer * linear.frequency_std,
        damping_ratio=linear.damping_ratio + lossier * linear.damping_std,
    )


def _parameters(problem: Problem, one: _Read, wanted: set[str]) -> dict[str, Strength]:
    """Parameters of a hypothesis' laws; their errors are those of the strengths alone."""
    found: dict[str, Strength] = {}
    std = np.sqrt(np.diag(one.solved.covariance))
    for place, k in enumerate(one.cell.columns):
        column, strength = problem.columns[k], float(one.solved.mean[place])
        if column.kind not in wanted:
            continue
        values = parameters_of(problem.readings, column, strength) or {}
        moved = parameters_of(problem.readings, column, strength + float(std[place])) or {}
        for name, value in values.items():
            label = f"{column.kind}.{name}"
            if value or label not in found:  # of force harmonics each column has one
                found[label] = Strength(value, abs(moved[name] - value))
    return found


class _Changes(NamedTuple):
    """Changes of a part at every state, over ω₀²; of another harmonic they are complex."""

    of_law: np.ndarray  # (state, law)
    functions: np.ndarray  # (state, function), of the remainder
    strength: np.ndarray
    rest: np.ndarray  # of the remainder's functions
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
    """Where the remainder of a part stands among a hypothesis' unknowns."""
    each = [functions.shape[1] for functions in problem.functions.values()]
    k = problem.parts.index(part)
    first = len(cell.columns) + sum(each[:k])
    return slice(first, first + each[k])


def _read(problem: Problem, cell: Cell, weight: float, least: dict[str, _Least]) -> _Read:
    solution = solved(problem, cell)
    k = len(cell.columns)
    std = np.sqrt(np.diag(solution.covariance))[:k]
    seen = np.abs(solution.mean[:k]) > priors.VISIBLE * std
    laws: dict[str, Laws] = {"instrument": ()}
    left = {"instrument": False}
    damping = _changes(problem, cell, solution, "damping")
    damped = 2 * problem.readings.damping_ratio + damping.of_law @ damping.strength + damping.left
    for part in problem.parts:
        small, visible = least[part]
        if part in DRAWN:
            small = small * np.abs(damped)
        change = _changes(problem, cell, solution, part)
        rest, each = change.left, change.of_law * change.strength
        whole = _size(np.sum(each, axis=1) + rest)
        odds = log_odds_of_remainder(problem, cell, solution, part)
        shown = odds > _NOT_NOISE and visible(rest)
        left[part] = bool(shown and np.max(np.abs(rest) / small) > 1)
        found = []
        for place, column in enumerate(cell.columns):
            own = each[:, place]
            matters = _size(own) > priors.NEGLIGIBLE * whole and np.max(np.abs(own) / small) > 1
            if seen[place] and matters and visible(own):
                found.append(problem.columns[column].kind)
        laws[part] = tuple(sorted(kind for kind in found if not is_instrument(kind)))
        if part.startswith("harmonic"):  # an exciter's are what it shows
            laws[part] = tuple(sorted(found))
    laws["instrument"] = tuple(
        sorted(
            {
                problem.columns[c].kind
                for place, c in enumerate(cell.columns)
                if seen[place] and is_instrument(problem.columns[c].kind)
            }
        )
    )
    return _Read(weight, cell, solution, laws, left)


def log_odds_of_remainder(problem: Problem, cell: Cell, solution: Solved, part: str) -> float:
    """ln of how much more probable the rows are with a part's remainder than without it.

    The density of no remainder before the rows are seen over that after: Dickey, Ann. Math. Stat.
    42 (1971) 204, doi:10.1214/aoms/1177693507.
    """
    size, some = cell.sizes[problem.parts.index(part)], _rest(problem, cell, part)
    if size == 0:
        return -np.inf
    mean, covariance = solution.mean[some], solution.covariance[some, some]
    _, log_det = np.linalg.slogdet(covariance / size**2)
    return 0.5 * float(log_det + mean @ np.linalg.solve(covariance, mean))


def _smallest(problem: Problem, part: str) -> _Least:
    """Changes that are no finding at every state, and whether rows show a change.

    Of stiffness and damping over the damping δ/ω₀.
    """
    if part in DRAWN:
        return np.full(len(problem.functions[part]), priors.BELOW_BANDWIDTH), lambda _: True
    one = problem.readings.harmonics[problem.parts.index(part) - 2]
    unit = problem.readings.natural_frequency**2

    def shown(change: np.ndarray) -> bool:
        return bool(np.linalg.norm(one.whitened(unit * change)) > priors.VISIBLE + 1)

    return np.full(len(one.weight), 1e-12), shown


def _size(values: np.ndarray) -> float:
    """How much a curve changes over the states, a constant included."""
    return float(np.sqrt(np.mean(np.abs(values) ** 2)))


def _part(
    problem: Problem,
    reads: list[_Read],
    part: str,
    best: _Read,
    found: tuple[Laws, tuple[Laws, ...], float],
) -> PartAnswer:
    """Which laws change a part, by how probable each is among all hypotheses."""
    effects, candidates, probability = found
    none = sum(one.weight for one in reads if not one.laws[part])
    instead = {law for group in candidates for law in group}
    silent = sum(
        one.weight
        for one in reads
        if not (one.laws[part] or one.left[part] or instead & {*one.instead(part)})
    )
    if part == "instrument":
        verdict = "none"
        if probability >= priors.NAMED:
            verdict = "named" if all(len(group) == 1 for group in candidates) else "ambiguous"
        return PartAnswer(part, verdict, effects, candidates, max(probability, none), None, None)
    explained = _explained(problem, reads, part, candidates) if effects else None
    remainder = _remainder(problem, reads, part, best)
    if silent >= 0.5:
        verdict, effects, candidates, probability, explained = "none", (), (), silent, None
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


def _classes(reads: list[_Read], part: str) -> tuple[Laws, tuple[Laws, ...], float]:
    """Effects of a part with the laws that may stand in their place, and their probability."""
    inclusion = _inclusion(reads, lambda one: one.laws[part])
    most = max(inclusion.values(), default=0.0)
    if part in DRAWN and 1 - priors.NAMED < most < priors.NAMED:
        reads = _with_instruments(reads, part, max(inclusion, key=lambda law: inclusion[law]))
        inclusion = _inclusion(reads, lambda one: one.laws[part])
    ranked = sorted(inclusion, key=lambda law: -inclusion[law])
    if not ranked or sum(one.weight for one in reads if one.laws[part]) < 0.5:
        return (), (), 0.0
    first, left = ranked[0], ranked[1:]
    group = [first]
    for law in left:
        if sum(inclusion[one] for one in group) >= priors.NAMED:
            break
        both = sum(one.weight for one in reads if law in one.laws[part] and first in one.laws[part])
        if inclusion[law] >= 0.02 and both < 0.5 * inclusion[law]:
            group.append(law)
    groups = [tuple(group)]
    for law in left:
        if law not in group and inclusion[law] >= 0.5:
            groups.append((law,))
    probability = sum(
        one.weight
        for one in reads
        if all(any(law in one.laws[part] for law in group) for group in groups)
    )
    return tuple(group[0] for group in groups), tuple(groups), float(probability)


def _inclusion(reads: list[_Read], laws: Callable[[_Read], Laws]) -> dict[str, float]:
    """Probability of every law."""
    found: dict[str, float] = {}
    for one in reads:
        for law in laws(one):
            found[law] = found.get(law, 0.0) + one.weight
    return found


def _with_instruments(reads: list[_Read], part: str, law: str) -> list[_Read]:
    """Instruments' errors that stand in the place of a part's law count as one of its laws.

    As an offset of the force does at resonance, where it does what friction does: neither is
    certain then, and one or the other is.
    """
    wholes = _inclusion(reads, lambda one: one.laws["instrument"])
    own = _inclusion(reads, lambda one: one.instead(part))
    both = _inclusion(reads, lambda one: one.laws["instrument"] if law in one.laws[part] else ())
    rivals = {
        kind
        for kind, p in own.items()
        if p >= 0.02 and wholes[kind] < priors.NAMED and both.get(kind, 0.0) < 0.5 * p
    }
    laws = ({*one.laws[part], *(rivals & {*one.instead(part)})} for one in reads)
    return [
        one._replace(laws={**one.laws, part: tuple(sorted(some))})
        for one, some in zip(reads, laws, strict=True)
    ]


def _explained(
    problem: Problem, reads: list[_Read], part: str, candidates: tuple[Laws, ...]
) -> Explained:
    """The fraction of a part's change that its laws account for."""
    named = {law for group in candidates for law in group}
    rng = np.random.default_rng(0)
    weights = np.array([one.weight for one in reads])
    has = np.array([bool(named & {*one.laws[part]}) for one in reads])
    weights = weights * has / np.sum(weights * has)
    fractions = []
    drawn, counts = np.unique(rng.choice(len(reads), _DRAWS, p=weights), return_counts=True)
    for one, times in zip([reads[k] for k in drawn], counts.tolist(), strict=True):
        change = _changes(problem, one.cell, one.solved, part)
        draws = rng.multivariate_normal(
            one.solved.mean, one.solved.covariance, size=times, method="eigh"
        )
        n_laws = len(one.cell.columns)
        mine = np.array([problem.columns[c].kind in named for c in one.cell.columns])
        law = (draws[:, :n_laws] * mine) @ change.of_law.T
        other = (draws[:, :n_laws] * ~mine) @ change.of_law.T
        rest = draws[:, _rest(problem, one.cell, part)] @ change.functions.T + other
        spread = _size_of if part not in DRAWN or _is_flat(law) else _std_of
        # What neither describing functions nor the rows tell of the law's own curve.
        unsure = np.hypot(priors.DESCRIBED * spread(law), priors.ALONG * spread(rest))
        unsure = unsure / np.maximum(spread(law), 1e-300) * rng.standard_normal(times)
        law, rest = law * (1 + unsure[:, None]), rest - law * unsure[:, None]
        fractions.append(1 - spread(rest) / np.maximum(spread(law + rest), 1e-300))
    every = np.clip(np.concatenate(fractions), 0.0, 1.0)
    return Explained(float(np.median(every)), *np.quantile(every, [0.025, 0.975]).tolist())


def _is_flat(curves: np.ndarray) -> bool:
    """Whether laws change a part by constants: their size counts then, and not how they vary."""
    return bool(np.median(_std_of(curves)) < 0.1 * np.median(_size_of(curves)))


def _std_of(curves: np.ndarray) -> np.ndarray:
    return np.std(curves, axis=1)


def _size_of(curves: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(np.abs(curves) ** 2, axis=1))


def _remainder(problem: Problem, reads: list[_Read], part: str, best: _Read) -> Remainder:
    readings = problem.readings
    x = np.geomspace(np.min(readings.relative_amplitude), 1.0, _POINTS)
    natural = readings.natural_frequency
    velocity = x * np.max(readings.amplitude) * natural
    change = _changes(problem, best.cell, best.solved, part)
    functions = problem.remainders(part, x)
    order = np.argsort(readings.relative_amplitude)
    at_states = change.of_law @ change.strength
    laws = np.interp(x, readings.relative_amplitude[order], at_states[order])
    if part in DRAWN:
        unit: Any = 1.0 if part == "stiffness" else 0.5
        unit_of_state = unit
        # What the linear test had wrong is no change with amplitude.
        softer, lossier = best.solved.linear
        beyond = np.real(readings.beyond) / natural**2
        beyond = beyond - 2 * softer * readings.linear.frequency_std / natural
        if part == "damping":
            beyond = np.imag(readings.beyond) / (2 * natural * readings.frequency)
            beyond = beyond - lossier * readings.linear.damping_std
        std = _std_along(functions, change.covariance)
        value = functions @ change.rest
    else:  # sizes, of the velocity at the sensor
        one = readings.harmonics[problem.parts.index(part) - 2]
        unit = velocity * one.order / (one.order**2 - 1)
        unit_of_state = readings.amplitude * natural * one.order / (one.order**2 - 1)
        beyond = np.where(one.weight > 0, np.abs(one.beyond) / natural**2, np.nan) * unit_of_state
        std = _std_along(functions, change.covariance)
        value = np.abs(laws + functions @ change.rest) - np.abs(laws)
        laws = np.abs(laws)
    probability = sum(one.weight for one in reads if one.left[part])
    return Remainder(
        *(velocity, unit * value, unit * laws, unit * std, readings.amplitude * natural, beyond),
        rms=_size(unit_of_state * change.left),
        significant=probability > 0.5,
    )
