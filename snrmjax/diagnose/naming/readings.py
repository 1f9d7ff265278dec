"""What every state reads of a mode beyond its model: changes of stiffness and damping, whitened.

With X = V/(iΩ) and the modal constant A a state has the dynamic stiffness Z = FA/X of the mode.
What it has beyond the model, Z − Z_model(a, Ω) = Σ θⱼhⱼ(a, Ω) + remainder + errors, is linear in
all that is unknown. Slopes, noise and sizes of levels' errors are those of smooth curves through
the states (`identify.test_model`); amplitudes are corrected for the errors that these find.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from snrmjax.diagnose import priors
from snrmjax.identify.test_model.balance import Balance, whitening
from snrmjax.identify.test_model.hyper import MASS, PHASE
from snrmjax.identify.test_model.posterior import TestPosterior, fit_test
from snrmjax.identify.test_model.priors import OFF_RESONANCE
from snrmjax.identify.test_model.states import TestStates
from snrmjax.model.effect_metadata import MotionScales


class ModelMotion(NamedTuple):
    """What a model has at a motion: as given, then with each stated parameter moved by its 1σ."""

    dynamic_stiffness: Complex[np.ndarray, "model state"]  # Z, 1/s²
    harmonics: Complex[np.ndarray, "model state order"]  # of the velocity, m/s, as recorded


MotionOfModel = Callable[[Complex[np.ndarray, " state"], Float[np.ndarray, " state"]], ModelMotion]
"""That of velocities (m/s) and frequencies (rad/s) of the mode alone."""


class RecordedHarmonics(NamedTuple):
    """Other harmonics that the reference sensor recorded."""

    order: tuple[int, ...]
    velocity: Complex[np.ndarray, "state order"]  # m/s
    std: Float[np.ndarray, "state order"]  # 1σ of each part, m/s; NaN where not recorded
    forced: Complex[np.ndarray, "state order"]  # m/s, of such a harmonic as large as the force


class HarmonicReading(NamedTuple):
    """A harmonic of the force that a motion x cos t needs beyond the model: cₕ/x, 1/s²."""

    order: int
    beyond: Complex[np.ndarray, " state"]
    weight: Float[np.ndarray, " state"]  # 1 over the 1σ of each part; 0 where not recorded
    forced: Complex[np.ndarray, " state"]  # by a harmonic of the exciter as large as the force
    errors: Complex[np.ndarray, "error state"]  # of the model's parameters, by their own 1σ

    def whitened(self, change: Complex[np.ndarray, "*several state"]) -> np.ndarray:
        """Changes (1/s²) as the rows show them, (…, row)."""
        parts = np.stack([np.real(change), np.imag(change)], axis=-1) * self.weight[:, None]
        return parts.reshape(*parts.shape[:-2], 2 * len(self.weight))


class LinearTest(NamedTuple):
    """The linear mode, and 1σ of what was stated of it."""

    natural_frequency: float  # rad/s
    damping_ratio: float
    frequency_std: float  # rad/s
    damping_std: float
    mass_std: float  # relative
    shape: float  # of the mode at the sensor, kg^-1/2
    side: float  # −1 where the sensor moves against the force, whose states are turned; else 1
    scales: MotionScales  # of the motions that were measured


class Readings(NamedTuple):
    """Whitened readings of a test."""

    linear: LinearTest
    velocity: Complex[np.ndarray, " state"]  # m/s, of the mode, corrected
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    order: Float[np.ndarray, " state"]  # place in the test, 0 to 1
    dynamic_stiffness: Complex[np.ndarray, " state"]  # Z, 1/s²
    slope: Complex[np.ndarray, " state"]  # dZ/d ln a by smooth curves
    root: Float[np.ndarray, "state 2 2"]  # whitens real and imaginary part of Z
    beyond: Complex[np.ndarray, " state"]  # Z less that of the model, 1/s²
    rows: Float[np.ndarray, " row"]  # Z less that of the model, whitened
    errors: Float[np.ndarray, "row error"]  # of levels, modal mass, linear test: by their own 1σ
    levels: Int[np.ndarray, "kind level"]  # columns of `errors` that are of levels
    level_std: Float[np.ndarray, " kind"]  # 1σ that these have
    posterior: TestPosterior
    harmonics: tuple[HarmonicReading, ...] = ()

    @property
    def natural_frequency(self) -> float:
        """ω₀ of the model, rad/s."""
        return self.linear.natural_frequency

    @property
    def constant(self) -> float:
        """A, the product of the mode's shapes at sensor and force, 1/kg."""
        return self.linear.side * float(np.mean(self.posterior.states.constant))

    @property
    def scales(self) -> MotionScales:
        """Typical magnitudes of the measured motions."""
        return self.linear.scales

    @property
    def damping_ratio(self) -> float:
        """ζ₀ of the model."""
        return self.linear.damping_ratio

    @property
    def amplitude(self) -> Float[np.ndarray, " state"]:
        """Displacement amplitudes of the mode at the sensor, m."""
        return np.abs(self.velocity) / self.frequency

    @property
    def largest(self) -> float:
        """The largest modal amplitude, kg^1/2 m."""
        return float(np.max(self.amplitude)) / abs(self.linear.shape)

    @property
    def relative_amplitude(self) -> Float[np.ndarray, " state"]:
        """Over the largest one."""
        return self.amplitude / np.max(self.amplitude)

    @property
    def relative_frequency(self) -> Float[np.ndarray, " state"]:
        """Ω/ω₀."""
        return self.frequency / self.natural_frequency

    def whitened(
        self, change: Complex[np.ndarray, "*several state"]
    ) -> Float[np.ndarray, "*several row"]:
        """Changes of Z (1/s²) as the rows show them."""
        parts = np.stack([np.real(change), np.imag(change)], axis=-1)
        white = np.einsum("nij,...nj->...ni", self.root, parts)
        return white.reshape(*white.shape[:-2], -1)


def readings_of(
    states: TestStates,
    order: Float[np.ndarray, " state"],
    model: MotionOfModel,
    linear: LinearTest,
    recorded: RecordedHarmonics | None = None,
    *,
    phases_known: bool = True,
) -> Readings:
    """The readings of a test's states, beyond a model.

    Where phases are not known (`phases_known`) they come from smooth curves: residuals of
    neighbouring states are then alike by themselves, and say nothing of a scatter of the frequency.
    """
    # Curves may go with the forcing frequency too.
    states = states._replace(off_resonance_std=OFF_RESONANCE)
    found = fit_test(
        states, compare_levels=False, tempered=phases_known, parts_of_noise=phases_known
    )
    states = found.states
    balance = Balance(
        *(states, found.terms, found.places, found.weight),
        np.zeros((len(states.level), 0), complex),
    )
    now, omega = balance.at(found.mean, found.corrections), states.frequency
    slopes = now.by_error
    std = found.hyper.noise * states.errors
    std[:, 1:3] = np.hypot(std[:, 1:3], priors.FLOOR)
    std = std / np.sqrt(found.share)
    root, _ = whitening(slopes, std, found.weight)
    # Records less the model's, by their straight line about the corrected motion.
    motion = model(now.velocity, omega)
    known, *moved = motion.dynamic_stiffness
    rows = now.z - known - np.sum(slopes * found.corrections, axis=1)
    rows = rows - 1j * now.z * found.mean[PHASE]
    of_gain = now.z if states.force_is_free else -now.z - now.slope
    linear_stiffness = linear.natural_frequency**2 * np.ones_like(now.z)
    of_levels = (of_gain, -1j * now.z, linear_stiffness, now.damping)
    columns = [linear.mass_std * now.model / (1 + found.mean[MASS])]
    natural = linear.natural_frequency
    columns.append(2 * natural * linear.frequency_std * np.ones_like(now.z))
    columns.append(2j * omega * natural * linear.damping_std)
    sizes = np.hypot(found.hyper.level_std, [priors.FLOOR, priors.FLOOR, 0.0, 0.0])
    columns += [one - known for one in moved]
    of_level = len(columns) + np.arange(4 * states.n_levels).reshape(4, -1)
    for kind, (column, size) in enumerate(zip(of_levels, sizes, strict=True)):
        if kind < 2:  # of which the records were corrected
            rows = rows + column * found.level_errors[states.level, kind]
        # Of which the standard deviation is that of differences: a gain or a phase that all levels
        # have in common is one of the instruments where it is much larger.
        columns += [size * column * (states.level == k) for k in range(states.n_levels)]
    for k, size in enumerate(OFF_RESONANCE):
        columns.append(size * now.with_frequency[:, k])
    none, slope = np.empty(0), now.slope
    bare = Readings(
        *(linear, now.velocity, omega, now.force, order, now.z, slope, root, rows, none, none),
        *(of_level, sizes),
        posterior=found,
    )
    higher = () if recorded is None else _higher(linear, states, now.velocity, motion, recorded)
    return bare._replace(
        rows=bare.whitened(rows), errors=bare.whitened(np.array(columns)).T, harmonics=higher
    )


def _higher(
    linear: LinearTest,
    states: TestStates,
    velocity: Complex[np.ndarray, " state"],
    motion: ModelMotion,
    recorded: RecordedHarmonics,
) -> tuple[HarmonicReading, ...]:
    """Harmonics of the force by those of the motion, which the linear mode answers.

    An error of a state's phase is one of time: it turns the fundamental alike.
    """
    omega, natural = states.frequency, linear.natural_frequency
    mode = linear.side * velocity / (1j * omega * linear.shape)
    found = []
    for place, order in enumerate(recorded.order):
        driven = order * omega
        stiffness = natural**2 - driven**2 + 2j * linear.damping_ratio * natural * driven
        turn = (np.abs(mode) / mode) ** order
        unit = -stiffness / (1j * driven * linear.shape) * turn / np.abs(mode)
        model, *moved = unit * motion.harmonics[:, :, place]
        beyond = unit * recorded.velocity[:, place] - model
        std = np.hypot(np.abs(unit) * recorded.std[:, place], priors.HARMONIC * np.abs(beyond))
        there = np.isfinite(std) & (std > 0)
        weight = np.where(there, 1 / np.where(there, std, 1.0), 0.0)
        forced = unit * recorded.forced[:, place]
        errors = np.array([one - model for one in moved]).reshape(-1, len(omega))
        beyond = np.where(there, beyond, 0.0)
        found.append(HarmonicReading(order, beyond, weight, forced, errors))
    return tuple(found)
