"""Which further test is expected to separate competing models (optimal design), in words."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.diagnose.design.design_points import (
    HARMONICS,
    DesignPoints,
    ModelRows,
    PredictedTest,
    Rows,
    columns_of,
    in_noise_units,
    predicted_test,
    refitted_chi_square,
    separation,
)
from snrmjax.diagnose.misfit.candidates import decide_by, only_by_calibration
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.predictions import Predicted
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.model_search import AS_GOOD, FoundEffects

STATES = 12
"""Of a level, or off resonance, in a further test."""

_RIVALS = 4  # of a class, that are compared
_WITHIN = np.radians(55.0)  # phases of a further level
_OFF = np.radians(np.linspace(30.0, 60.0, STATES // 2))
_HIGHER, _LOWER = (1.5, 2.0), 0.5  # times the velocities of the largest and the smallest level
_CERTAIN = 1.64  # 1σ below the expected gain: noise leaves 95 % of tests with more
_ORDINARY = 3e-3  # of the largest velocity: noise of harmonics measured without special care
_RESOLVED = {"velocity": 0.01, "frequency": 2e-4}  # relative, by a careful test
_SEEN = 0.1  # of the larger of two harmonics, above which the smaller one has a phase
_CLOSER, _FINEST = 3.0, 1e-4  # factor between the noise floors tried, and the lowest one


class ProposedLevel(NamedTuple):
    """Where in the measured range a test is, by its resonance."""

    level: int  # that is measured again, or whose velocities are scaled
    force: float  # N
    frequency: float  # Hz


class PlannedStates(NamedTuple):
    """The steady states of a test as the answer predicts them."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    velocity: Float[np.ndarray, " state"]  # m/s, at the reference sensor


class DiscriminatingTest(NamedTuple):
    """A test that is expected to separate the models that a diagnosis could not.

    What does not apply is None: a calibration has no level, and only harmonics have a noise that
    they need.
    """

    kind: str  # "harmonics", "off_resonance", "lower_level", "higher_level", "calibration"
    sentence: str
    quantity: str | None = None  # in which the models differ most: "harmonic 2", "velocity", …
    place: ProposedLevel | None = None
    states: int | None = None
    phase: tuple[float, float] | None = None  # degrees off resonance, on both sides
    harmonics: tuple[int, ...] = ()
    harmonic_std: float | None = None  # m/s, that they need
    expected_gain: float | None = None  # of χ² over the rival that is separated least well
    needed_gain: float | None = None
    calibration_too: bool = False  # whether effects stay open that only a calibration separates
    planned: PlannedStates | None = None

    @property
    def settles(self) -> bool:
        """Whether the expected gain is enough."""
        if self.expected_gain is None or self.needed_gain is None:
            return self.kind == "calibration"
        return self.expected_gain >= self.needed_gain


class _Option(NamedTuple):
    """Some rows of a predicted test."""

    kind: str
    place: int  # of the design points
    orders: tuple[int, ...]  # of harmonics that count
    of_force: bool
    floor: float | None  # m/s, that harmonics need


def discriminating_test(found: FoundEffects, places: tuple[int, ...]) -> DiscriminatingTest | None:
    """The cheapest test that is expected to reject the competing models of some classes.

    Every member of a class at one of the `places` is taken for true in turn and predicts the test;
    its rivals are refitted to the measured and the further states together, to first order. A
    test is enough where it leaves the rivals behind with 95 % probability. Where none is enough
    it is the one that comes nearest; None where no rival can be compared.
    """
    misfit = found.misfit
    speed = np.abs(np.asarray(misfit.predictions.chosen.states.velocity)[:, 0])
    floor = _floor(misfit)
    ordinary = floor if floor is not None else _ORDINARY * float(speed.max())
    groups = [list(_rivals(found, place)) for place in places]
    every = [rival for group in groups for rival in group]
    tried = [(found.fit, every)]
    tried += [(truth, [found.fit, *group]) for group in groups for truth in group]
    hypotheses = [
        _Hypothesis(misfit, truth, [fit for fit in rivals if _can_be_told(truth, fit)], ordinary)
        for truth, rivals in tried
    ]
    best: DiscriminatingTest | None = None
    for option in _options(ordinary, float(speed.max()), measured=floor is not None):
        worst: DiscriminatingTest | None = None
        for hypothesis in hypotheses if every else []:
            test = hypothesis.expected(option)
            if test is not None and (worst is None or _share(test) < _share(worst)):
                worst = test
            if worst is None or not worst.settles:
                break
        if worst is not None and worst.settles:
            return worst
        if worst is not None and (best is None or _share(worst) > _share(best)):
            best = worst
    return best


def _can_be_told(one: EffectFit, other: EffectFit) -> bool:
    """Whether two answers differ by more than what only a calibration separates."""
    differ = set(one.kinds) ^ set(other.kinds)
    return bool(differ) and not only_by_calibration(differ)


def _share(test: DiscriminatingTest) -> float:
    return (test.expected_gain or 0.0) / (test.needed_gain or 1.0)


def _floor(misfit: WeightedMisfit) -> float | None:
    """Noise of harmonics, m/s; None where none were measured."""
    chosen = misfit.predictions.chosen
    first = 2 * len(chosen.sensors)
    own = np.asarray(chosen.states.own_std)[:, first:] * np.sqrt(2)
    own = own * np.abs(np.asarray(chosen.states.velocity)[:, :1])
    return float(np.median(own[own > 0])) if np.any(own > 0) else None


def _design_points(misfit: WeightedMisfit) -> tuple[DesignPoints, ...]:
    """The largest level as it is, both ends off resonance, a smaller level and larger ones."""
    states = misfit.predictions.chosen.states
    level, velocity = np.asarray(states.level), np.asarray(states.velocity)[:, 0]
    peaks = [np.abs(velocity[level == k]).max() for k in range(level.max() + 1)]
    low, top = int(np.argmin(peaks)), int(np.argmax(peaks))
    again = np.sort(np.angle(velocity[level == top]))
    off, spread = np.concatenate([-_OFF[::-1], _OFF]), np.linspace(-_WITHIN, _WITHIN, STATES)
    higher = [DesignPoints(top, scale, spread) for scale in _HIGHER]
    return (
        DesignPoints(top, 1.0, again[:: -(-len(again) // (2 * STATES))]),
        DesignPoints(low, 1.0, off),
        DesignPoints(top, 1.0, off),
        DesignPoints(low, _LOWER, spread),
        *higher,
    )


def _options(ordinary: float, largest: float, *, measured: bool) -> Iterator[_Option]:
    """Measurements, the cheapest first."""
    known = HARMONICS if measured else ()
    each = [(h,) for h in HARMONICS] + [HARMONICS]
    if not measured:
        yield from (_Option("harmonics", 0, orders, False, ordinary) for orders in each)
    yield from (_Option("off_resonance", place, known, True, None) for place in (1, 2))
    yield _Option("lower_level", 3, known, True, None)
    yield from (_Option("higher_level", place, known, True, None) for place in (4, 5))
    floor = ordinary
    if not measured:
        yield from (_Option("higher_level", p, HARMONICS, True, floor) for p in (4, 5))
    while floor > _FINEST * largest:
        floor = max(floor / _CLOSER, _FINEST * largest)
        yield from (_Option("harmonics", 0, orders, False, floor) for orders in each)
        yield from (_Option("higher_level", p, HARMONICS, True, floor) for p in (4, 5))


def _rivals(found: FoundEffects, place: int) -> Iterator[EffectFit]:
    """The rivals of the answer in the class at a place, with their parameters from the table."""
    misfit = found.misfit
    for name in found.classes[place][1 : 1 + _RIVALS]:
        kinds = {name if k == place else kind for k, kind in enumerate(found.fit.kinds)}
        # One effect with more parameters may stand for two.
        fit = _from_table(found, kinds) or _from_table(found, {name})
        columns = fit and columns_of(misfit.predictions, fit)
        if fit is None or columns is None:
            continue
        rows = in_noise_units(misfit, columns)
        if np.all(np.isfinite(rows.left)) and np.all(np.isfinite(rows.slopes)):
            least = refitted_chi_square(rows, misfit.noise.shared)
            yield fit._replace(rows=rows.left, slopes=rows.slopes, chi_square=least)


def _from_table(found: FoundEffects, kinds: set[str]) -> EffectFit | None:
    """The last fit of some kinds that a table has, without its rows."""
    for row in (row for step in found.table[::-1] for row in step):
        if {label.partition(".")[0] for label in row.parameters} == kinds:
            values = np.array(list(row.parameters.values()))
            rows, slopes = np.zeros(0), np.zeros((0, len(values)))
            labels = tuple(row.parameters)
            return EffectFit(
                tuple(kinds),
                labels,
                values,
                row.chi_square,
                rows,
                slopes,
                values,
                values,
                row.status,
            )
    return None


class _Hypothesis:
    """One model taken for true, the tests that it predicts, and its rivals."""

    def __init__(
        self, misfit: WeightedMisfit, truth: EffectFit, rivals: list[EffectFit], floor: float
    ):
        self.misfit, self.truth, self.rivals = misfit, truth, rivals
        self.floor = floor  # m/s, of harmonics where an option needs none
        self.points = _design_points(misfit)

    @cached_property
    def _tests(self) -> dict[float, PredictedTest]:
        """By the noise of harmonics."""
        first = predicted_test(self.misfit, self.truth, self.points, self.floor)
        return {self.floor: first}

    @cached_property
    def _predicted(self) -> list[Predicted | None]:
        """Of the truth, then of the rivals."""
        predictions = self._tests[self.floor].misfit.predictions
        return [columns_of(predictions, fit) for fit in (self.truth, *self.rivals)]

    @cached_property
    def _measured(self) -> list[tuple[Rows, float]]:
        """Rows of the measured states and χ² after a refit: of the truth, then of the rivals."""
        rows = [Rows(fit.rows, fit.slopes) for fit in (self.truth, *self.rivals)]
        return [(one, refitted_chi_square(one, self.misfit.noise.shared)) for one in rows]

    def expected(self, option: _Option) -> DiscriminatingTest | None:
        """The expected gain of an option over the rival that it separates least well."""
        floor = self.floor if option.floor is None else option.floor
        if floor not in self._tests:
            self._tests[floor] = self._tests[self.floor].with_floor(floor)
        test = self._tests[floor]
        kept = _rows(test, option)
        exact, *others = self._predicted
        if exact is None or not kept.any():
            return None
        own = ModelRows(*self._measured[0], in_noise_units(test.misfit, exact))
        found = []
        for fit, before, columns in zip(self.rivals, self._measured[1:], others, strict=True):
            if columns is None:
                continue
            its = ModelRows(*before, in_noise_units(test.misfit, columns))
            gain = separation(self.misfit, test.misfit, own, its, kept)
            n = self.misfit.n_rows
            needed = _needed(fit.criterion(n) - self.truth.criterion(n))
            said = _difference(test, (self.truth, exact), (fit, columns), option)
            found.append((gain, needed, *said))
        if not found:
            return None
        gain, needed, quantity, words = min(found, key=lambda one: one[0] / one[1])
        one = self.points[option.place]
        size = np.degrees(np.abs(one.phase))
        place = ProposedLevel(
            level=int(self.misfit.level_numbers[one.level]),
            force=test.force[option.place],
            frequency=test.frequency[option.place] / (2 * np.pi),
        )
        return DiscriminatingTest(
            kind=option.kind,
            sentence=f"{_what_to_measure(place, one.scale, test, option)}: {words}.",
            quantity=quantity,
            place=place,
            states=len(one.phase),
            phase=(float(size.min()), float(size.max())),
            harmonics=option.orders if option.floor is not None else (),
            harmonic_std=option.floor,
            expected_gain=float(gain),
            needed_gain=needed,
            planned=_planned(test, option),
        )


def _planned(test: PredictedTest, option: _Option) -> PlannedStates:
    states, mine = test.misfit.predictions.chosen.states, test.members[option.place]
    columns = (states.frequency, states.force, np.abs(states.velocity[:, 0]))
    return PlannedStates(*(np.asarray(column)[mine] for column in columns))


def _what_to_measure(
    place: ProposedLevel, scale: float, test: PredictedTest, option: _Option
) -> str:
    """Where and what to measure, in words."""
    at = f"near {place.frequency:.4g} Hz"
    level = f"level {place.level} ({place.force:.3g} N)"
    closely = ""
    if option.floor is not None:
        velocity = np.asarray(test.misfit.predictions.chosen.states.velocity)[:, 0]
        largest = np.abs(velocity[test.members[option.place]]).max()
        names = " and ".join(str(h) for h in option.orders)
        plural = "s" if len(option.orders) > 1 else ""
        closely = (
            f"harmonic{plural} {names} to better than {100 * option.floor / largest:.2g} % of the "
            f"fundamental ({option.floor:.2g} m/s)"
        )
    if option.kind == "harmonics":
        return f"Measure {closely} at {level} {at}"
    if option.kind == "off_resonance":
        return f"Measure {STATES} states 30° to 60° off resonance, on both sides, at {level} {at}"
    beside = f", with {closely}" if closely else ""
    return (
        f"Add a level of {place.force:.3g} N, {scale:g} times the velocities of level "
        f"{place.level}, with {STATES} states within 55° of resonance {at}{beside}"
    )


def _needed(ahead: float) -> float:
    """Expected gain over a rival that leaves it out of the class, if the truth is now `ahead`.

    A gain G of χ² scatters by 2√G.
    """
    least = max(AS_GOOD - ahead, 0.0)
    return float((_CERTAIN + np.sqrt(_CERTAIN**2 + least)) ** 2)


def _rows(test: PredictedTest, option: _Option) -> Bool[np.ndarray, " row"]:
    noise = test.misfit.noise
    mine = test.members[option.place][noise.state]
    first = 2 * len(test.misfit.predictions.chosen.sensors)
    wanted = [noise.column < 2] if option.of_force else []
    for order in option.orders:
        at = first + 2 * HARMONICS.index(order)
        wanted.append((noise.column == at) | (noise.column == at + 1))
    return mine & np.logical_or.reduce(wanted)


def _difference(
    test: PredictedTest,
    truth: tuple[EffectFit, Predicted],
    rival: tuple[EffectFit, Predicted],
    option: _Option,
) -> tuple[str, str]:
    """In what two models differ most under an option, and by how much, in words."""
    states = test.misfit.predictions.chosen.states
    velocity, omega = np.asarray(states.velocity)[:, 0], np.asarray(states.frequency)
    columns = rival[1].columns[0] - truth[1].columns[0]
    apart = columns[:, 0::2] + 1j * columns[:, 1::2]
    mine = np.flatnonzero(test.members[option.place])
    mine = mine[np.isfinite(apart[mine]).all(axis=1)]
    kinds = truth[0].kinds, rival[0].kinds
    one, other = (
        " and ".join(kind for kind in own if kind not in its) for own, its in (kinds, kinds[::-1])
    )
    if not mine.size:
        return "velocity", f"with {one} there is such a motion, with {other} there is none"
    at = mine[np.argmin(np.abs(np.angle(velocity[mine])))]
    if option.floor is not None:
        places = [HARMONICS.index(h) for h in option.orders]
        own = np.asarray(states.harmonics)[at, 0, places] / np.abs(velocity[at])
        its = own + apart[at, [len(test.misfit.predictions.chosen.sensors) + k for k in places]]
        most = int(np.argmax(np.abs(own - its)))
        name = f"harmonic {option.orders[most]}"
        sizes = [f"{round(100 * abs(h[most]), 6):.2g} %" for h in (own, its)]
        both = np.abs([own[most], its[most]])
        turned = abs(np.degrees(np.angle(its[most] / own[most]))) if both.min() > 0 else 0.0
        seen = both.min() > _SEEN * both.max() and turned > 1.0
        turn = f", turned by {turned:.0f}°" if seen else ""
        words = f"{sizes[0]} of the fundamental with {one}, {sizes[1]}{turn} with {other}"
        return name, f"{name} is {words}"
    if option.kind == "off_resonance":
        share = 100 * float(np.abs(apart[mine, 0]).max())
        return "velocity", f"with {one} and {other} velocities differ by up to {share:.2g} %"
    # The force goes with iΩδ + Δω̃² there: more of it is less velocity, or a higher frequency.
    modes, j = test.misfit.model.modes, test.misfit.model.modes.mode_of_interest
    slower = float(apart[at, 0].real)
    shift = -float(apart[at, 0].imag * modes.damping_ratio[j])
    if abs(slower) / _RESOLVED["velocity"] > abs(shift) / _RESOLVED["frequency"]:
        speed = float(np.abs(velocity[at]))
        values, unit, name = (speed, speed / max(1 + slower, 0.1)), "m/s", "velocity"
    else:
        hertz = float(omega[at]) / (2 * np.pi)
        values, unit, name = (hertz, hertz * (1 + shift)), "Hz", "frequency"
    return (
        name,
        f"{name} at resonance {values[0]:.4g} {unit} with {one}, {values[1]:.4g} with {other}",
    )


def recommended_test(found: FoundEffects) -> DiscriminatingTest | None:
    """The test that is expected to separate the effects that fit equally well.

    A calibration where nothing else separates them; None where nothing is open.
    """
    open_places = [k for k, group in enumerate(found.classes) if len(group) > 1]
    places = tuple(
        k for k in open_places if set(found.classes[k]) - only_by_calibration(found.classes[k])
    )
    if not open_places:
        return None
    unclear = {kind for k in open_places for kind in found.classes[k]}
    too = any(only_by_calibration(found.classes[k]) for k in open_places)
    test = discriminating_test(found, places) if places else None
    if test is not None:
        return test._replace(calibration_too=too)
    return DiscriminatingTest("calibration", decide_by(unclear, harmonics=True)) if too else None


def recommendation(
    found: FoundEffects,
    test: DiscriminatingTest | None,
    open_questions: Sequence[str],
    *,
    phases: bool,
) -> str | None:
    """What would decide, each measurement in one sentence and said once; None if nothing is open.

    Arguments: `open_questions` are the measurements that would resolve doubts; `phases` says
    whether any phase of the velocity is known.
    """
    groups = [set(group) for group in found.classes if len(group) > 1]
    harmonics = bool(found.misfit.predictions.chosen.orders)
    sentences = []
    if groups and not phases:
        sentences.append("Record the phase of the velocity relative to the force.")
    if test is None or test.kind == "calibration":
        sentences += [decide_by(set().union(*groups), harmonics=harmonics)] if groups else []
    else:
        static = [only_by_calibration(group) for group in groups]
        sentences += [decide_by(group, harmonics=True) for group in static if group]
        if not test.settles:
            sentences.append(
                "No single test that was compared is expected to decide; the most informative one:"
            )
        sentences.append(test.sentence)
    sentences += [f"{text[0].upper()}{text[1:]}." for text in open_questions]
    return " ".join(_once(sentences)) or None


def _once(sentences: Sequence[str]) -> list[str]:
    """Every measurement once: the most specific sentence of those that begin alike."""
    every = list(dict.fromkeys(sentences))
    asked = [one.rstrip(".").lower() for one in every]
    return [
        one
        for k, one in enumerate(every)
        if not any(asked[k] in other for j, other in enumerate(asked) if j != k)
    ]
