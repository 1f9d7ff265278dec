"""Which further test is expected to separate competing models (optimal design), in words."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.design.design_points import (
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
from snrmjax.diagnose.misfit.programs import COMPARED
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.model_search import FoundEffects

STATES = 12
"""Of a level, or off resonance, in a further test."""

_CERTAIN = 1.64  # 1σ below the expected gain: noise leaves 95 % of tests with more


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
    # Without any, that of harmonics which are measured without special care.
    ordinary = floor if floor is not None else 3e-3 * float(speed.max())
    groups = [list(_rivals(found, place)) for place in places]
    every = [rival for group in groups for rival in group]
    tried = [(found.fit, every)]
    tried += [(truth, [found.fit, *group]) for group in groups for truth in group]
    hypotheses = []
    for truth, rivals in tried:
        differ = [set(truth.kinds) ^ set(fit.kinds) for fit in rivals]
        # Some answers differ only by what a calibration separates.
        told = [
            fit
            for fit, own in zip(rivals, differ, strict=True)
            if own and not only_by_calibration(own)
        ]
        hypotheses.append(_Hypothesis(misfit, truth, told, ordinary))
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
    ends, near = np.radians(np.linspace(30.0, 60.0, STATES // 2)), np.radians(55.0)
    off, spread = np.concatenate([-ends[::-1], ends]), np.linspace(-near, near, STATES)
    return (
        DesignPoints(top, 1.0, again[:: -(-len(again) // (2 * STATES))]),
        DesignPoints(low, 1.0, off),
        DesignPoints(top, 1.0, off),
        DesignPoints(low, 0.5, spread),
        DesignPoints(top, 1.5, spread),
        DesignPoints(top, 2.0, spread),
    )


def _options(ordinary: float, largest: float, *, measured: bool) -> Iterator[_Option]:
    """Measurements, the cheapest first."""
    known = COMPARED if measured else ()
    each = [(h,) for h in COMPARED] + [COMPARED]
    if not measured:
        yield from (_Option("harmonics", 0, orders, False, ordinary) for orders in each)
    yield from (_Option("off_resonance", place, known, True, None) for place in (1, 2))
    yield _Option("lower_level", 3, known, True, None)
    yield from (_Option("higher_level", place, known, True, None) for place in (4, 5))
    floor = ordinary
    if not measured:
        yield from (_Option("higher_level", p, COMPARED, True, floor) for p in (4, 5))
    while floor > 1e-4 * largest:
        floor = max(floor / 3, 1e-4 * largest)
        yield from (_Option("harmonics", 0, orders, False, floor) for orders in each)
        yield from (_Option("higher_level", p, COMPARED, True, floor) for p in (4, 5))


def _rivals(found: FoundEffects, place: int) -> Iterator[EffectFit]:
    """The rivals of the answer in the class at a place, with their parameters from the table."""
    misfit = found.misfit
    for name in found.classes[place][1:5]:
        kinds = {name if k == place else kind for k, kind in enumerate(found.fit.kinds)}
        # One effect with more parameters may stand for two.
        tables = (row.parameters for step in found.table[::-1] for row in step)
        own = [({label.partition(".")[0] for label in one}, one) for one in tables]
        last = [one for wanted in (kinds, {name}) for has, one in own if has == wanted][:1]
        if not last:
            continue
        values, nothing = np.array(list(last[0].values())), np.zeros(0)
        which = tuple(dict.fromkeys(label.partition(".")[0] for label in last[0]))
        fit = EffectFit(
            which, tuple(last[0]), values, np.inf, nothing, nothing[:, None], values, values
        )
        columns = columns_of(misfit.predictions, fit)
        if columns is None:
            continue
        rows = in_noise_units(misfit, columns)
        if np.all(np.isfinite(rows.left)) and np.all(np.isfinite(rows.slopes)):
            least = refitted_chi_square(rows, misfit.noise.covariance)
            yield fit._replace(rows=rows.left, slopes=rows.slopes, chi_square=least)


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
        return [(one, refitted_chi_square(one, self.misfit.noise.covariance)) for one in rows]

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
        for fit, before, its in zip(self.rivals, self._measured[1:], others, strict=True):
            if its is None:
                continue
            rival = ModelRows(*before, in_noise_units(test.misfit, its))
            gain = separation(self.misfit, test.misfit, own, rival, kept)
            n = self.misfit.n_rows
            # A gain G of χ² scatters by 2√G.
            ahead = fit.criterion(n) - self.truth.criterion(n)
            least = max(priors.AS_GOOD_BY_CRITERION - ahead, 0.0)
            needed = float((_CERTAIN + np.sqrt(_CERTAIN**2 + least)) ** 2)
            said = _difference(test, (self.truth, exact), (fit, its), option)
            found.append((gain, needed, *said))
        if not found:
            return None
        gain, needed, quantity, words = min(found, key=lambda one: one[0] / one[1])
        one, mine = self.points[option.place], test.members[option.place]
        states = test.misfit.predictions.chosen.states
        columns = (states.frequency, states.force, np.abs(states.velocity[:, 0]))
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
            planned=PlannedStates(*(np.asarray(column)[mine] for column in columns)),
        )


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


def _rows(test: PredictedTest, option: _Option) -> Bool[np.ndarray, " row"]:
    noise = test.misfit.noise
    mine = test.members[option.place][noise.state]
    first = 2 * len(test.misfit.predictions.chosen.sensors)
    wanted = [noise.column < 2] if option.of_force else []
    for order in option.orders:
        at = first + 2 * COMPARED.index(order)
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
        places = [COMPARED.index(h) for h in option.orders]
        own = np.asarray(states.harmonics)[at, 0, places] / np.abs(velocity[at])
        its = own + apart[at, [len(test.misfit.predictions.chosen.sensors) + k for k in places]]
        most = int(np.argmax(np.abs(own - its)))
        name = f"harmonic {option.orders[most]}"
        sizes = [f"{round(100 * abs(h[most]), 6):.2g} %" for h in (own, its)]
        both = np.abs([own[most], its[most]])
        turned = abs(np.degrees(np.angle(its[most] / own[most]))) if both.min() > 0 else 0.0
        seen = both.min() > 0.1 * both.max() and turned > 1.0
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
    if abs(slower) > 50 * abs(shift):  # a careful test resolves 1 % of one, 0.02 % of the other
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
    # Every measurement once: the most specific sentence of those that begin alike.
    every = list(dict.fromkeys(sentences))
    asked = [one.rstrip(".").lower() for one in every]
    said = [
        one
        for k, one in enumerate(every)
        if not any(asked[k] in other for j, other in enumerate(asked) if j != k)
    ]
    return " ".join(said) or None
