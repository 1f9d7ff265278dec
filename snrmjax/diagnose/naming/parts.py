"""The answer by parts: laws that change stiffness and damping, their fraction, what is left."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.naming import priors
from snrmjax.diagnose.naming.columns import is_instrument, parameters_of
from snrmjax.diagnose.naming.evidence import Cell, Problem, Solved, solved
from snrmjax.model.library.free_laws import DisplacementDampingLaw, StiffnessLaw

PARTS = ("stiffness", "damping")
DRAWN = {"stiffness": StiffnessLaw.kind, "damping": DisplacementDampingLaw.kind}
"""The law that a remainder of a part is."""
_CELLS = 150  # most probable hypotheses whose strengths are solved for
_DRAWS = 500  # of fractions
_POINTS = 60  # of a drawn remainder

Laws = tuple[str, ...]


class Explained(NamedTuple):
    """Fraction of a part's change that laws account for, and its 95 % band."""

    value: float
    low: float
    high: float


class Remainder(NamedTuple):
    """What is left of a part: a curve of amplitude."""

    velocity: Float[np.ndarray, " point"]  # m/s, of the mode at its natural frequency
    value: Float[np.ndarray, " point"]  # relative, of ω₀² or of 2ω₀²
    laws: Float[np.ndarray, " point"]  # what the laws add, alike
    std: Float[np.ndarray, " point"]
    state_velocity: Float[np.ndarray, " state"]  # m/s, alike
    state_change: Float[np.ndarray, " state"]  # what each state reads of the whole change
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


class _Read(NamedTuple):
    """One hypothesis, with what it says of every part."""

    weight: float
    cell: Cell
    solved: Solved
    laws: dict[str, Laws]  # that are seen, by part
    left: dict[str, bool]  # whether a remainder is seen


def naming_of(problem: Problem, cells: list[Cell]) -> Naming:
    """What explains most of a test's readings."""
    cells = cells[:_CELLS]
    weight = np.exp([cell.log_evidence - cells[0].log_evidence for cell in cells])
    weight = weight / weight.sum()
    reads = [_read(problem, cell, float(w)) for cell, w in zip(cells, weight, strict=True)]
    answers: dict[Laws, float] = {}
    for one in reads:
        drawn = (DRAWN[part] for part in PARTS if one.left[part])
        laws = tuple(sorted({*drawn, *(law for part in one.laws.values() for law in part)}))
        answers[laws] = answers.get(laws, 0.0) + one.weight
    answers = dict(sorted(answers.items(), key=lambda pair: -pair[1]))
    classes = {part: _classes(reads, part) for part in (*PARTS, "instrument")}
    wanted = {kind for effects, _, _ in classes.values() for kind in effects}
    with_all = [one for one in reads if wanted <= {k for some in one.laws.values() for k in some}]
    best = max(with_all or reads, key=lambda one: one.weight)
    parts = [_part(problem, reads, part, best, classes[part]) for part in classes]
    linear, (softer, lossier) = problem.readings.linear, best.solved.linear
    return Naming(
        *(tuple(parts), answers, _parameters(problem, best, wanted), best.solved.misfit),
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
            found[f"{column.kind}.{name}"] = Strength(value, abs(moved[name] - value))
    return found


def _changes(problem: Problem, cell: Cell, solution: Solved, part: str) -> tuple[np.ndarray, ...]:
    """Of a part at every state: changes by law and by the remainder's functions, and their mean."""
    k = len(cell.columns)
    take = np.real if part == "stiffness" else np.imag
    over = 1.0 if part == "stiffness" else problem.readings.relative_frequency
    changes = [take(problem.columns[c].change) / over for c in cell.columns]
    laws = np.array(changes).reshape(k, len(problem.functions)).T
    return laws, problem.functions, solution.mean[:k], solution.mean[_rest(problem, cell, part)]


def _rest(problem: Problem, cell: Cell, part: str) -> slice:
    """Where the remainder of a part stands among a hypothesis' unknowns."""
    n = problem.functions.shape[1]
    first = len(cell.columns) + PARTS.index(part) * n
    return slice(first, first + n)


def _read(problem: Problem, cell: Cell, weight: float) -> _Read:
    solution = solved(problem, cell)
    k = len(cell.columns)
    std = np.sqrt(np.diag(solution.covariance))[:k]
    seen = np.abs(solution.mean[:k]) > priors.VISIBLE * std
    laws: dict[str, Laws] = {"instrument": ()}
    left = {"instrument": False}
    small = priors.BELOW_BANDWIDTH * problem.readings.relative_damping
    for part in PARTS:
        of_law, functions, strength, rest = _changes(problem, cell, solution, part)
        remainder = functions @ rest
        some = _rest(problem, cell, part)
        covariance = solution.covariance[some, some]
        size = np.sqrt(np.einsum("si,ij,sj->s", functions, covariance, functions))
        whole = _size(of_law @ strength + remainder)
        seen_left = np.max(np.abs(remainder) / (size + 1e-300)) > priors.VISIBLE + 1
        left[part] = bool(seen_left and _size(remainder / small) > 1)
        found = []
        for place, column in enumerate(cell.columns):
            kind, own = problem.columns[column].kind, of_law[:, place] * strength[place]
            matters = _size(own) > priors.NEGLIGIBLE * whole and _size(own / small) > 1
            if not (seen[place] and matters):
                continue
            found.append(kind)
        laws[part] = tuple(sorted(kind for kind in found if not is_instrument(kind)))
    laws["instrument"] = tuple(
        sorted(
            problem.columns[c].kind
            for place, c in enumerate(cell.columns)
            if seen[place] and is_instrument(problem.columns[c].kind)
        )
    )
    return _Read(weight, cell, solution, laws, left)


def _size(values: np.ndarray) -> float:
    """How much a curve changes over the states, a constant included."""
    return float(np.sqrt(np.mean(values**2)))


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
    silent = sum(one.weight for one in reads if not one.laws[part] and not one.left[part])
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
        and explained.value >= priors.EXPLAINED
        and (explained.low >= priors.EXPLAINED or not remainder.significant)
    ):
        single = all(len(group) == 1 for group in candidates)
        verdict = "named" if single else "ambiguous"
    else:
        verdict = "drawn"
    return PartAnswer(part, verdict, effects, candidates, probability, explained, remainder)


def _classes(reads: list[_Read], part: str) -> tuple[Laws, tuple[Laws, ...], float]:
    """Effects of a part with the laws that may stand in their place, and their probability."""
    inclusion: dict[str, float] = {}
    for one in reads:
        for law in one.laws[part]:
            inclusion[law] = inclusion.get(law, 0.0) + one.weight
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
        laws, functions, _, _ = _changes(problem, one.cell, one.solved, part)
        draws = rng.multivariate_normal(
            one.solved.mean, one.solved.covariance, size=times, method="eigh"
        )
        n_laws = len(one.cell.columns)
        mine = np.array([problem.columns[c].kind in named for c in one.cell.columns])
        law = (draws[:, :n_laws] * mine) @ laws.T
        other = (draws[:, :n_laws] * ~mine) @ laws.T
        rest = draws[:, _rest(problem, one.cell, part)] @ functions.T + other
        spread = _size_of if _is_flat(law) else _std_of
        fractions.append(1 - spread(rest) / np.maximum(spread(law + rest), 1e-300))
    every = np.clip(np.concatenate(fractions), 0.0, 1.0)
    return Explained(float(np.median(every)), *np.quantile(every, [0.025, 0.975]).tolist())


def _is_flat(curves: np.ndarray) -> bool:
    """Whether laws change a part by constants: their size counts then, and not how they vary."""
    return bool(np.median(_std_of(curves)) < 0.1 * np.median(_size_of(curves)))


def _std_of(curves: np.ndarray) -> np.ndarray:
    return np.std(curves, axis=1)


def _size_of(curves: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(curves**2, axis=1))


def _remainder(problem: Problem, reads: list[_Read], part: str, best: _Read) -> Remainder:
    readings = problem.readings
    x = np.geomspace(np.min(readings.relative_amplitude), 1.0, _POINTS)
    functions, some = problem.remainders(x), _rest(problem, best.cell, part)
    unit = 1.0 if part == "stiffness" else 0.5
    value = unit * functions @ best.solved.mean[some]
    covariance = best.solved.covariance[some, some]
    std = unit * np.sqrt(np.einsum("pi,ij,pj->p", functions, covariance, functions))
    at_states = unit * problem.functions @ best.solved.mean[some]
    probability = sum(one.weight for one in reads if one.left[part])
    velocity = x * np.max(readings.amplitude) * readings.natural_frequency
    of_law, _, strength, _ = _changes(problem, best.cell, best.solved, part)
    order = np.argsort(readings.relative_amplitude)
    laws = unit * np.interp(x, readings.relative_amplitude[order], (of_law @ strength)[order])
    natural, beyond = readings.natural_frequency, readings.beyond
    change = np.real(beyond) / natural**2
    if part == "damping":
        change = np.imag(beyond) / (2 * natural * readings.frequency)
    return Remainder(
        *(velocity, value, laws, std, readings.amplitude * natural, change),
        rms=_size(at_states),
        significant=probability > 0.5,
    )
