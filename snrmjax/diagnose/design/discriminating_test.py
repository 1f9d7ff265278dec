"""Which further test is expected to separate competing models (optimal design)."""

from collections.abc import Iterator
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
from snrmjax.diagnose.fitted_effects import FittedEffects
from snrmjax.diagnose.misfit.candidates import decide_by, only_by_calibration
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.predictions import Predicted
from snrmjax.diagnose.misfit.programs import COMPARED
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

STATES = 12
"""Number of states of a further test."""


class OperatingPoint(NamedTuple):
    """The level of a proposed test, and force and frequency at its resonance."""

    level: int  # measured again, or with scaled velocities
    force: float  # N
    frequency: float  # Hz


class PlannedStates(NamedTuple):
    """The steady states of a test, as predicted by the answer."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    velocity: Float[np.ndarray, " state"]  # m/s, at the reference sensor


class DiscriminatingTest(NamedTuple):
    """A test that is expected to separate the models that a diagnosis could not.

    What does not apply is None, such as the level of a calibration.
    """

    kind: str  # "harmonics", "off_resonance", "lower_level", "higher_level", "calibration"
    measurement: Fact | None = None  # what to measure where, and how the models differ there
    quantity: str | None = None  # with the largest difference: "harmonic 2", "velocity", …
    operating_point: OperatingPoint | None = None
    states: int | None = None
    phase: tuple[float, float] | None = None  # degrees off resonance, on both sides
    harmonics: tuple[int, ...] = ()
    harmonic_std: float | None = None  # m/s, required noise of these
    expected_gain: float | None = None  # of χ², over the closest rival
    needed_gain: float | None = None
    calibration_too: bool = False  # whether some effects need a calibration to be separated
    planned: PlannedStates | None = None

    @property
    def settles(self) -> bool:
        """Whether the expected gain suffices."""
        if self.expected_gain is None or self.needed_gain is None:
            return self.kind == "calibration"
        return self.expected_gain >= self.needed_gain


class _Option(NamedTuple):
    """A measurement to compare: some rows of a predicted test."""

    kind: str
    points: int  # index of the design points
    orders: tuple[int, ...]  # of harmonics used
    of_force: bool
    floor: float | None  # m/s, required noise of harmonics


def discriminating_test(
    fitted: FittedEffects, indices: tuple[int, ...]
) -> DiscriminatingTest | None:
    """The cheapest test that is expected to reject the rival models of some classes.

    Each member of the classes with these `indices` is assumed true in turn and predicts the test;
    its rivals are refitted to the measured and further states together, to first order. A test
    suffices if it rejects all rivals with 95 % probability. If none does, the best one is returned;
    None where no rival can be compared.
    """
    misfit = fitted.misfit
    speed = np.abs(np.asarray(misfit.predictions.chosen.states.velocity)[:, 0])
    floor = _floor(misfit)
    # Without recorded harmonics: typical noise, 0.3 % of the largest velocity.
    ordinary = floor if floor is not None else 3e-3 * float(speed.max())
    groups = [list(_rivals(fitted, index)) for index in indices]
    all_rivals = [rival for group in groups for rival in group]
    tried = [(fitted.fit, all_rivals)]
    tried += [(truth, [fitted.fit, *group]) for group in groups for truth in group]
    hypotheses = []
    for truth, rivals in tried:
        differ = [set(truth.kinds) ^ set(fit.kinds) for fit in rivals]
        # Leave out rivals that only a calibration separates.
        distinct = [
            fit
            for fit, kinds in zip(rivals, differ, strict=True)
            if kinds and not only_by_calibration(kinds)
        ]
        hypotheses.append(_Hypothesis(misfit, truth, distinct, ordinary))
    best: DiscriminatingTest | None = None
    for option in _options(ordinary, float(speed.max()), measured=floor is not None):
        worst: DiscriminatingTest | None = None
        for hypothesis in hypotheses if all_rivals else []:
            test = hypothesis.expected(option)
            if test is not None and (worst is None or _fraction(test) < _fraction(worst)):
                worst = test
            if worst is None or not worst.settles:
                break
        if worst is not None and worst.settles:
            return worst
        if worst is not None and (best is None or _fraction(worst) > _fraction(best)):
            best = worst
    return best


def _fraction(test: DiscriminatingTest) -> float:
    return (test.expected_gain or 0.0) / (test.needed_gain or 1.0)


def _floor(misfit: WeightedMisfit) -> float | None:
    """Noise of harmonics, m/s; None where none were measured."""
    chosen = misfit.predictions.chosen
    first = 2 * len(chosen.sensors)
    noise = np.asarray(chosen.states.own_std)[:, first:] * np.sqrt(2)
    noise = noise * np.abs(np.asarray(chosen.states.velocity)[:, :1])
    return float(np.median(noise[noise > 0])) if np.any(noise > 0) else None


def _design_points(misfit: WeightedMisfit) -> tuple[DesignPoints, ...]:
    """The largest level again, off resonance at both ends, a smaller level and larger ones."""
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
    """The measurements to compare, the cheapest first."""
    known = COMPARED if measured else ()
    each = [(h,) for h in COMPARED] + [COMPARED]
    if not measured:
        yield from (_Option("harmonics", 0, orders, False, ordinary) for orders in each)
    yield from (_Option("off_resonance", index, known, True, None) for index in (1, 2))
    yield _Option("lower_level", 3, known, True, None)
    yield from (_Option("higher_level", index, known, True, None) for index in (4, 5))
    floor = ordinary
    if not measured:
        yield from (_Option("higher_level", p, COMPARED, True, floor) for p in (4, 5))
    while floor > 1e-4 * largest:
        floor = max(floor / 3, 1e-4 * largest)
        yield from (_Option("harmonics", 0, orders, False, floor) for orders in each)
        yield from (_Option("higher_level", p, COMPARED, True, floor) for p in (4, 5))


def _rivals(fitted: FittedEffects, index: int) -> Iterator[EffectFit]:
    """The rivals of the answer within one class."""
    covariance = fitted.misfit.noise.covariance
    by_kinds = {frozenset(one.kinds): one for one in reversed(fitted.rivals)}
    for name in fitted.classes[index][1:5]:
        kinds = {name if k == index else kind for k, kind in enumerate(fitted.fit.kinds)}
        # One effect with more parameters may replace two.
        rival = by_kinds.get(frozenset(kinds), by_kinds.get(frozenset({name})))
        if rival is not None and np.all(np.isfinite(rival.rows)):
            least = refitted_chi_square(Rows(rival.rows, rival.slopes), covariance)
            yield rival._replace(chi_square=least)


class _Hypothesis:
    """One model assumed true, the tests that it predicts, and its rivals."""

    def __init__(
        self, misfit: WeightedMisfit, truth: EffectFit, rivals: list[EffectFit], floor: float
    ):
        self.misfit, self.truth, self.rivals = misfit, truth, rivals
        self.floor = floor  # m/s, noise of harmonics unless an option requires another
        self.points = _design_points(misfit)

    @cached_property
    def _tests(self) -> dict[float, PredictedTest]:
        """Predicted tests by noise of harmonics."""
        first = predicted_test(self.misfit, self.truth, self.points, self.floor)
        return {self.floor: first}

    @cached_property
    def _predicted(self) -> list[Predicted | None]:
        """Predictions of the truth, then of the rivals."""
        predictions = self._tests[self.floor].misfit.predictions
        return [columns_of(predictions, fit) for fit in (self.truth, *self.rivals)]

    @cached_property
    def _measured(self) -> list[tuple[Rows, float]]:
        """Rows of the measured states and χ² after a refit: of the truth, then of the rivals."""
        rows = [Rows(fit.rows, fit.slopes) for fit in (self.truth, *self.rivals)]
        return [(row, refitted_chi_square(row, self.misfit.noise.covariance)) for row in rows]

    def expected(self, option: _Option) -> DiscriminatingTest | None:
        """The expected gain of an option, over the closest rival."""
        floor = self.floor if option.floor is None else option.floor
        if floor not in self._tests:
            self._tests[floor] = self._tests[self.floor].with_floor(floor)
        test = self._tests[floor]
        kept = _rows(test, option)
        exact, *others = self._predicted
        if exact is None or not kept.any():
            return None
        true_rows = ModelRows(*self._measured[0], in_noise_units(test.misfit, exact))
        gains = []
        for fit, before, prediction in zip(self.rivals, self._measured[1:], others, strict=True):
            if prediction is None:
                continue
            rival = ModelRows(*before, in_noise_units(test.misfit, prediction))
            gain = separation(self.misfit, test.misfit, true_rows, rival, kept)
            # A gain G of χ² has the standard deviation 2√G: require G − 1.64·2√G ≥ least.
            ahead = fit.criterion - self.truth.criterion
            least = max(priors.AS_GOOD_BY_CRITERION - ahead, 0.0)
            needed = float((priors.ONE_SIDED + np.sqrt(priors.ONE_SIDED**2 + least)) ** 2)
            gains.append(
                (gain, needed, *_difference(test, (self.truth, exact), (fit, prediction), option))
            )
        if not gains:
            return None
        gain, needed, quantity, difference = min(gains, key=lambda one: one[0] / one[1])
        points, rows = self.points[option.points], test.members[option.points]
        states = test.misfit.predictions.chosen.states
        columns = (states.frequency, states.force, np.abs(states.velocity[:, 0]))
        planned = PlannedStates(*(np.asarray(column)[rows] for column in columns))
        operating_point = OperatingPoint(
            level=int(self.misfit.level_numbers[points.level]),
            force=test.force[option.points],
            frequency=test.frequency[option.points] / HERTZ,
        )
        harmonics = option.orders if option.floor is not None else ()
        phase_deg = np.degrees(np.abs(points.phase))
        measurement = Fact(
            "measure_test",
            kind=option.kind,
            **operating_point._asdict(),
            scale=points.scale,
            states=STATES,
            harmonics=harmonics,
            harmonic_std=option.floor,
            largest=float(np.max(planned.velocity, initial=0.0)),
            difference=difference,
        )
        return DiscriminatingTest(
            kind=option.kind,
            measurement=measurement,
            quantity=quantity,
            operating_point=operating_point,
            states=len(points.phase),
            phase=(float(phase_deg.min()), float(phase_deg.max())),
            harmonics=harmonics,
            harmonic_std=option.floor,
            expected_gain=float(gain),
            needed_gain=needed,
            planned=planned,
        )


def _rows(test: PredictedTest, option: _Option) -> Bool[np.ndarray, " row"]:
    noise = test.misfit.noise
    chosen = test.members[option.points][noise.state]
    first = 2 * len(test.misfit.predictions.chosen.sensors)
    wanted = [noise.column < 2] if option.of_force else []
    for order in option.orders:
        at = first + 2 * COMPARED.index(order)
        wanted.append((noise.column == at) | (noise.column == at + 1))
    return chosen & np.logical_or.reduce(wanted)


def _difference(
    test: PredictedTest,
    truth: tuple[EffectFit, Predicted],
    rival: tuple[EffectFit, Predicted],
    option: _Option,
) -> tuple[str, Fact]:
    """The quantity with the largest difference between two models, and the difference."""
    states = test.misfit.predictions.chosen.states
    velocity, omega = np.asarray(states.velocity)[:, 0], np.asarray(states.frequency)
    columns = rival[1].columns[0] - truth[1].columns[0]
    apart = columns[:, 0::2] + 1j * columns[:, 1::2]
    rows = np.flatnonzero(test.members[option.points])
    rows = rows[np.isfinite(apart[rows]).all(axis=1)]
    kinds = truth[0].kinds, rival[0].kinds
    models = tuple(tuple(kind for kind in kinds[k] if kind not in kinds[1 - k]) for k in range(2))
    if not rows.size:
        return "velocity", Fact("motion_of_one", models=models)
    at = rows[np.argmin(np.abs(np.angle(velocity[rows])))]
    if option.floor is not None:
        indices = [COMPARED.index(h) for h in option.orders]
        first = np.asarray(states.harmonics)[at, 0, indices] / np.abs(velocity[at])
        second = (
            first + apart[at, [len(test.misfit.predictions.chosen.sensors) + k for k in indices]]
        )
        most = int(np.argmax(np.abs(first - second)))
        magnitudes = np.abs([first[most], second[most]])
        rotation = (
            abs(np.degrees(np.angle(second[most] / first[most]))) if magnitudes.min() > 0 else 0.0
        )
        visible = magnitudes.min() > 0.1 * magnitudes.max() and rotation > 1.0
        harmonic = {"harmonic": option.orders[most], "fractions": tuple(magnitudes.tolist())}
        turned = {"turned_deg": float(rotation) if visible else None}
        difference = Fact("harmonics_apart", models=models, **harmonic, **turned)
        return f"harmonic {option.orders[most]}", difference
    if option.kind == "off_resonance":
        fraction = float(np.abs(apart[rows, 0]).max())
        return "velocity", Fact("velocities_apart", models=models, fraction=fraction)
    # At resonance F ∝ iΩδ + Δω̃²: more damping lowers the velocity, more stiffness shifts Ω.
    modes, j = test.misfit.model.modes, test.misfit.model.modes.mode_of_interest
    velocity_drop = float(apart[at, 0].real)
    shift = -float(apart[at, 0].imag * modes.damping_ratio[j])
    # A careful test resolves 1 % of velocity, 0.02 % of frequency.
    if abs(velocity_drop) > 50 * abs(shift):
        quantity, value = "velocity", float(np.abs(velocity[at]))
        values = value, value / max(1 + velocity_drop, 0.1)
    else:
        quantity, value = "frequency", float(omega[at]) / HERTZ
        values = value, value * (1 + shift)
    return quantity, Fact("resonances_apart", models=models, quantity=quantity, values=values)


def recommended_test(fitted: FittedEffects) -> DiscriminatingTest | None:
    """The test that is expected to separate effects of equal fit.

    A calibration where nothing else separates them; None if nothing is open.
    """
    static = [only_by_calibration(group) for group in fitted.classes]
    indices = tuple(
        k
        for k, (group, alike) in enumerate(zip(fitted.classes, static, strict=True))
        if len(group) > 1 and set(group) - alike
    )
    test = discriminating_test(fitted, indices) if indices else None
    if test is not None:
        return test._replace(calibration_too=any(static))
    return DiscriminatingTest("calibration") if any(static) else None


def recommendation(
    fitted: FittedEffects,
    test: DiscriminatingTest | None,
    *,
    phases: bool,
) -> Fact | None:
    """The measurements that would decide, without duplicates; None if nothing is open.

    Arguments: `phases`: whether the phases of the velocity are known.
    """
    groups = [set(group) for group in fitted.classes if len(group) > 1]
    measurements: list[Fact | str] = []
    if groups and not phases:
        measurements.append(Fact("record_phase"))
    if test is None or test.measurement is None:
        harmonics = bool(fitted.misfit.predictions.chosen.orders)
        measurements += decide_by(set().union(*groups), harmonics=harmonics) if groups else []
    else:
        for static in map(only_by_calibration, groups):
            measurements += decide_by(static, harmonics=True) if static else []
        measurements += [] if test.settles else [Fact("no_test_settles")]
        measurements.append(test.measurement)
    measurements = list(dict.fromkeys(measurements))
    return Fact("recommendation", measurements=tuple(measurements)) if measurements else None
