"""Readings: every state's excess dynamic stiffness over the model, whitened.

With X = V/(iΩ) and the modal constant A, a state has the dynamic stiffness Z = FA/X of the mode.
Its excess Z − Z_model(a, Ω) = Σ θⱼhⱼ(a, Ω) + remainder + errors is linear in all unknowns. Slopes,
noise and level errors are those of smooth curves through the states (`identify.test_model`), and
the amplitudes are corrected for the errors that these curves estimate.
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

_AMPLITUDES = (-0.66, -0.32, -0.16, 0.0, 0.16, 0.32, 0.66)
"""ln of amplitudes over the measured ones: gain errors from −48 to 93 %."""


class ModelMotion(NamedTuple):
    """A model's prediction at a motion: as given, then with each stated parameter shifted by 1σ."""

    dynamic_stiffness: Complex[np.ndarray, "model state"]  # Z, 1/s²
    harmonics: Complex[np.ndarray, "model state order"]  # of the velocity, m/s, as recorded


MotionOfModel = Callable[[Complex[np.ndarray, " state"], Float[np.ndarray, " state"]], ModelMotion]
"""Prediction for velocities (m/s) and frequencies (rad/s) of the mode alone."""


class RecordedHarmonics(NamedTuple):
    """Other harmonics recorded at the reference sensor."""

    order: tuple[int, ...]
    velocity: Complex[np.ndarray, "state order"]  # m/s
    std: Float[np.ndarray, "state order"]  # 1σ of each part, m/s; NaN where not recorded
    forced: Complex[np.ndarray, "state order"]  # m/s, by an exciter harmonic as large as the force


class ModelByAmplitude(NamedTuple):
    """A quantity of the model at other amplitudes than the measured ones."""

    logs: Float[np.ndarray, " node"]  # ln of amplitude over measured amplitude
    value: Complex[np.ndarray, "node state"]

    def at(self, log: Float[np.ndarray, " state"]) -> Complex[np.ndarray, " state"]:
        """By Lagrange's polynomials; NaN beyond the nodes."""
        whole = np.zeros(self.value.shape[1], complex)
        for node, value in zip(self.logs, self.value, strict=True):
            others = self.logs[self.logs != node]
            whole += value * np.prod((log[:, None] - others) / (node - others), axis=1)
        inside = (log >= self.logs[0]) & (log <= self.logs[-1])
        return np.where(inside, whole, np.nan)


class HarmonicReading(NamedTuple):
    """Excess harmonic of the force over the model, for a motion x cos t: cₕ/x, 1/s²."""

    order: int
    beyond: Complex[np.ndarray, " state"]
    weight: Float[np.ndarray, " state"]  # 1 over the 1σ of each part; 0 where not recorded
    forced: Complex[np.ndarray, " state"]  # by an exciter harmonic as large as the force
    errors: Complex[np.ndarray, "error state"]  # by 1σ of each of the model's parameters
    model: ModelByAmplitude  # cₕ/x of the model, 1/s²

    def whitened(self, change: Complex[np.ndarray, "*several state"]) -> np.ndarray:
        """Changes (1/s²) whitened to rows, (…, row)."""
        parts = np.stack([np.real(change), np.imag(change)], axis=-1) * self.weight[:, None]
        return parts.reshape(*parts.shape[:-2], 2 * len(self.weight))


class LinearTest(NamedTuple):
    """The linear mode, with stated 1σ."""

    natural_frequency: float  # rad/s
    damping_ratio: float
    frequency_std: float  # rad/s
    damping_std: float
    mass_std: float  # relative
    shape: float  # of the mode at the sensor, kg^-1/2
    side: float  # sign of shape × participation; states with −1 are sign-changed
    scales: MotionScales  # of the measured motions


class Readings(NamedTuple):
    """Whitened readings of a test."""

    linear: LinearTest
    velocity: Complex[np.ndarray, " state"]  # m/s, of the mode, corrected
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    order: Float[np.ndarray, " state"]  # position in the test, 0 to 1
    dynamic_stiffness: Complex[np.ndarray, " state"]  # Z, 1/s²
    slope: Complex[np.ndarray, " state"]  # dZ/d ln a of smooth curves
    model: ModelByAmplitude  # Z of the model, 1/s²
    root: Float[np.ndarray, "state 2 2"]  # whitening of real and imaginary part of Z
    beyond: Complex[np.ndarray, " state"]  # Z less that of the model, 1/s²
    rows: Float[np.ndarray, " row"]  # Z less that of the model, whitened
    errors: Float[np.ndarray, "row error"]  # by 1σ of modal mass, linear test, levels
    levels: Int[np.ndarray, "kind level"]  # indices of the level errors in `errors`
    level_std: Float[np.ndarray, " kind"]  # their 1σ, of `LEVEL_ERRORS`
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
        """Amplitudes over the largest one."""
        return self.amplitude / np.max(self.amplitude)

    @property
    def relative_frequency(self) -> Float[np.ndarray, " state"]:
        """Ω/ω₀."""
        return self.frequency / self.natural_frequency

    @property
    def frequency_over_level(self) -> Float[np.ndarray, " state"]:
        """Ω over the natural frequency of the state's level, as smooth curves estimate its error.

        With it the motion's other harmonics respond, where warming changes the whole structure.
        """
        stiffness = self.posterior.level_errors[self.posterior.states.level, 2]
        return self.relative_frequency / np.sqrt(1 + stiffness)

    def whitened(
        self, change: Complex[np.ndarray, "*several state"]
    ) -> Float[np.ndarray, "*several row"]:
        """Changes of Z (1/s²) whitened to rows."""
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
    """The readings of a test's states, in excess of a model.

    Phases that are not known (`phases_known`) come from smooth curves: residuals of neighbouring
    states are then correlated by construction and do not show a scatter of the frequency.
    """
    # Curves may depend on the forcing frequency too.
    states = states._replace(off_resonance_std=OFF_RESONANCE)
    posterior = fit_test(
        states,
        robust=None,
        compare_levels=False,
        power_likelihood=phases_known,
        parts_of_noise=phases_known,
    )
    states = posterior.states
    balance = Balance(
        states,
        posterior.terms,
        posterior.layout,
        posterior.weight,
        np.zeros((len(states.level), 0), complex),
    )
    now, omega = balance.at(posterior.mean, posterior.corrections), states.frequency
    slopes = now.by_error
    std = posterior.hyper.noise * states.errors
    std[:, 1:3] = np.hypot(std[:, 1:3], priors.FLOOR)
    std = std / np.sqrt(posterior.fraction)
    root, _ = whitening(slopes, std, posterior.weight)
    # Measured less model Z, linearised about the corrected motion.
    motion = model(now.velocity, omega)
    known, *shifted = motion.dynamic_stiffness
    logs, others = _at_other_amplitudes(model, motion, now.velocity, omega)
    rows = now.z - known - np.sum(slopes * posterior.corrections, axis=1)
    rows = rows - 1j * now.z * posterior.mean[PHASE]
    of_gain = now.z if states.force_is_free else -now.z - now.slope
    linear_stiffness = linear.natural_frequency**2 * np.ones_like(now.z)
    of_levels = (of_gain, -1j * now.z, linear_stiffness, now.damping)
    columns = [linear.mass_std * now.model / (1 + posterior.mean[MASS])]
    natural = linear.natural_frequency
    columns.append(2 * natural * linear.frequency_std * np.ones_like(now.z))
    columns.append(2j * omega * natural * linear.damping_std)
    level_stds = np.hypot(posterior.hyper.level_std, [priors.FLOOR, priors.FLOOR, 0.0, 0.0])
    columns += [one - known for one in shifted]
    of_level = len(columns) + np.arange(4 * states.n_levels).reshape(4, -1)
    for kind, (column, level_std) in enumerate(zip(of_levels, level_stds, strict=True)):
        if kind < 2:  # gain and phase: restore the corrections of the records
            rows = rows + column * posterior.level_errors[states.level, kind]
        # `level_std` is that of differences between levels: a much larger common gain or phase is
        # an instrument error.
        columns += [level_std * column * (states.level == k) for k in range(states.n_levels)]
    for k, std_off in enumerate(OFF_RESONANCE):
        columns.append(std_off * now.with_frequency[:, k])
    none, slope = np.empty(0), now.slope
    bare = Readings(
        linear,
        now.velocity,
        omega,
        now.force,
        order,
        now.z,
        slope,
        ModelByAmplitude(logs, np.array([one.dynamic_stiffness[0] for one in others])),
        root,
        rows,
        none,
        none,
        of_level,
        level_stds,
        posterior=posterior,
    )
    higher: tuple[HarmonicReading, ...] = ()
    if recorded is not None:
        higher = _higher(linear, states, now.velocity, motion, recorded, logs, others)
    return bare._replace(
        rows=bare.whitened(rows), errors=bare.whitened(np.array(columns)).T, harmonics=higher
    )


def _at_other_amplitudes(
    model: MotionOfModel,
    measured: ModelMotion,
    velocity: Complex[np.ndarray, " state"],
    omega: Float[np.ndarray, " state"],
) -> tuple[np.ndarray, list[ModelMotion]]:
    """ln of amplitudes over the measured ones, and the model's motions, as far as it has them."""
    motions = [measured if u == 0 else model(velocity * np.exp(u), omega) for u in _AMPLITUDES]
    there = [np.isfinite(one.dynamic_stiffness[0]).all() for one in motions]
    logs = np.array(_AMPLITUDES)[there]
    return logs, [one for one, exists in zip(motions, there, strict=True) if exists]


def _higher(
    linear: LinearTest,
    states: TestStates,
    velocity: Complex[np.ndarray, " state"],
    motion: ModelMotion,
    recorded: RecordedHarmonics,
    logs: Float[np.ndarray, " node"],
    others: list[ModelMotion],
) -> tuple[HarmonicReading, ...]:
    """Harmonics of the force from those of the motion, by the linear mode's dynamic stiffness.

    A phase error of a state is a time shift: harmonics are taken relative to the fundamental.
    """
    omega, natural = states.frequency, linear.natural_frequency
    mode = linear.side * velocity / (1j * omega * linear.shape)
    readings = []
    for index, order in enumerate(recorded.order):
        driven = order * omega
        stiffness = natural**2 - driven**2 + 2j * linear.damping_ratio * natural * driven
        rotation = (np.abs(mode) / mode) ** order
        unit = -stiffness / (1j * driven * linear.shape) * rotation / np.abs(mode)
        model, *shifted = unit * motion.harmonics[:, :, index]
        beyond = unit * recorded.velocity[:, index] - model
        std = np.hypot(np.abs(unit) * recorded.std[:, index], priors.HARMONIC * np.abs(beyond))
        there = np.isfinite(std) & (std > 0)
        weight = np.where(there, 1 / np.where(there, std, 1.0), 0.0)
        forced = unit * recorded.forced[:, index]
        errors = np.array([one - model for one in shifted]).reshape(-1, len(omega))
        beyond = np.where(there, beyond, 0.0)
        by_log = [
            one.harmonics[0, :, index] * np.exp(-u) for u, one in zip(logs, others, strict=True)
        ]
        by_amplitude = ModelByAmplitude(logs, unit * np.array(by_log))
        readings.append(HarmonicReading(order, beyond, weight, forced, errors, by_amplitude))
    return tuple(readings)
