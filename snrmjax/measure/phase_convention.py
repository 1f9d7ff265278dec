"""Whether recorded phasors are velocities relative to the force, or seem to mean something else."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import jax
import numpy as np
from jaxtyping import Float

from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of

_LEAST_STATES = 6
_NEAR = 0.2  # of a level's largest |V|/F: states that are nearer to resonance than others
_POWERS = (0, 2, -1, 4, 1)  # of the amplitude, in the curves of stiffness and damping
_PER_TERM = 5  # states for each of them
_WRONG, _RIGHT = 0.25, 0.15  # relative misfit of the phasors: as given above, otherwise read below
_DAMPED = 0.25  # mean cosine of the phase near resonance, at least, of another reading
_BETTER, _AS_GOOD = 3.0, 1.5  # ratios of misfits: of another reading at least; of equal ones
_WRONG_SIZE = 10.0  # ratio of modal constants, that no law of amplitude passes for


class _Reading(NamedTuple):
    """A velocity that recorded phasors V may stand for: turn·V, or turn·V* where conjugated."""

    turn: complex
    conjugated: bool

    @property
    def words(self) -> str:
        """What is to be done with the phasors."""
        turns = {1j: "turned by +90°", -1j: "turned by -90°", -1: "turned by 180°"}
        parts = ["conjugated"] if self.conjugated else []
        if self.turn in turns:
            parts.append(turns[self.turn])
        return " and then ".join(parts)


_READINGS = (
    *(_Reading(turn, False) for turn in (1, 1j, -1j, -1)),
    *(_Reading(turn, True) for turn in (1, 1j, -1j, -1)),
)


class _NearResonance(NamedTuple):
    """States of the sensor that moves most, with the sign of the model's mode there."""

    phase: Float[np.ndarray, " state"]  # rad, of V relative to the force and that sign
    mobility: Float[np.ndarray, " state"]  # |V|/F
    frequency: Float[np.ndarray, " state"]  # rad/s
    amplitude: Float[np.ndarray, " state"]  # over the largest


class _Fit(NamedTuple):
    """A single mode fitted to the phasors read in one way."""

    misfit: float  # relative, rms
    constant: float  # 1/m, the modal constant
    cosine: float  # mean of cos φ


def wrong_phases(data: SteadyStates, modes: LinearModes | Structure) -> tuple[str, ...]:
    """A sentence where measured phases are clearly not those of a velocity relative to the force.

    Near resonance a single mode has F cos φ = d(a)|V| and ΩF sin φ = (k(a) − mΩ²)|V|, with m and
    d(a) above zero and smooth functions of the amplitude a. Both are fitted by linear least
    squares to the phases as given and to seven other readings: conjugated, turned by ±90°
    (displacement or acceleration in place of velocity) or 180° (sign of a sensor or of the force),
    and both. Where the phases as given are clearly refuted and another reading clearly fits, that
    one is named, or all where several fit alike.

    Arguments: `data` measured states, `modes` whose shape and participation give the sign of a
    velocity at resonance. Returns no sentence or one. Not differentiable.
    Validity: one resonance; states on both sides of it, or else conjugation cannot be told.
    """
    modes = modes_of(modes)
    if isinstance(data.velocity, jax.core.Tracer) or data.sensors != modes.sensors:
        return ()
    j = modes.mode_of_interest
    shape = np.asarray(modes.mode_shape)[:, j]
    r = int(np.argmax(np.abs(shape)))
    constant = float(shape[r] * modes.participation[j])
    near = _near_resonance(data, r, constant)
    if near is None:
        return ()
    fits = [_fitted(near, reading) for reading in _READINGS]
    misfit = np.array([fits[0].misfit, *(_of_a_damped_mode(one) for one in fits[1:])])
    best = float(misfit.min())
    if best > _RIGHT or misfit[0] < max(_WRONG, _BETTER * best):
        known = np.any(np.isfinite(np.asarray(data.force)))
        return _wrong_size(near, fits[0], abs(constant)) if known else ()
    chosen = np.flatnonzero(misfit <= _AS_GOOD * best)
    known = np.any(np.isfinite(np.asarray(data.force)))
    size = fits[chosen[0]].constant / abs(constant) if known else np.nan
    said = _in_words(_READINGS[chosen[0]], size, float(near.frequency.mean()), constant > 0)
    if len(chosen) > 1:
        listed = " or ".join(_READINGS[k].words for k in chosen)
        said = (
            "the phases are not those of a velocity relative to the force, but would be if "
            f"{listed}, which states at resonance or on one side of it do not tell apart."
        )
    return (
        f"{said} (A single mode misses the phasors by {100 * misfit[0]:.0f} % as they are, by "
        f"{100 * best:.2g} % read so.)",
    )


def _wrong_size(near: _NearResonance, fit: _Fit, constant: float) -> tuple[str, ...]:
    """A sentence where velocity over force is not that of the model's modal mass by far.

    Only where states away from resonance refute that mass: at resonance any will do.
    """
    ratio = fit.constant / constant
    if fit.misfit > _RIGHT or not np.isfinite(ratio) or 1 / _WRONG_SIZE < ratio < _WRONG_SIZE:
        return ()
    held = _fitted(near, _READINGS[0], mass=near.frequency.mean() * near.mobility.max() / constant)
    if held.misfit < max(_WRONG, _BETTER * fit.misfit):
        return ()
    return (
        f"velocity over force is {ratio:.3g} times that of a mode with the model's `shape` times "
        "`participation`: the force seems not to be in newtons (a drive voltage belongs into "
        "`drive_v`), the velocity not in m/s, or the modal mass is another one; damping and "
        "what is found off resonance mean nothing until that is mended, or the gain of the force "
        f"is free. (A single mode with the model's modal mass misses the phasors by "
        f"{100 * held.misfit:.0f} %, with its own by {100 * fit.misfit:.2g} %.)",
    )


def _near_resonance(data: SteadyStates, r: int, constant: float) -> _NearResonance | None:
    data = jax.tree.map(np.asarray, data)
    velocity = np.sign(constant) * data.velocity[:, r]
    force, omega, level = map(np.asarray, (data.force, data.frequency, data.level))
    if not np.any(np.isfinite(force)):
        force = np.asarray(data.drive)
    use = np.asarray(data.measured & ~data.phase_unknown)[:, r]
    use = use & np.isfinite(velocity) & (velocity != 0) & (force > 0) & (omega > 0)
    mobility = np.abs(velocity) / np.where(use, force, 1.0)
    for k in np.unique(level[use]):
        mine = use & (level == k)
        use = use & (~mine | (mobility >= _NEAR * mobility[mine].max()))
    if use.sum() < _LEAST_STATES:
        return None
    amplitude = np.abs(velocity[use]) / omega[use]
    phase = np.angle(velocity[use])
    return _NearResonance(phase, mobility[use], omega[use], amplitude / amplitude.max())


def _of_a_damped_mode(fit: _Fit) -> float:
    """The misfit, infinite where no damping shows: any phases fit far from resonance."""
    return fit.misfit if fit.cosine > _DAMPED else np.inf


def _fitted(near: _NearResonance, reading: _Reading, mass: float | None = None) -> _Fit:
    phasor = np.exp(1j * near.phase)
    phasor = reading.turn * (phasor.conj() if reading.conjugated else phasor)
    mean, most = near.frequency.mean(), near.mobility.max()
    relative, ratio = near.mobility / most, near.frequency / mean
    terms = np.clip(len(ratio) // _PER_TERM, 1, len(_POWERS))
    curve = np.stack([near.amplitude**p for p in _POWERS[:terms]], axis=1) * relative[:, None]
    stiffness = curve / ratio[:, None]
    inertia = relative * ratio
    if mass is None:
        mass, sine = _least_squares(np.column_stack([stiffness, -inertia]), phasor.imag)
    else:
        sine = _least_squares(stiffness, phasor.imag + mass * inertia)[1] - mass * inertia
    if mass <= 0:  # none that a mode can have
        mass, sine = 0.0, _least_squares(stiffness, phasor.imag)[1]
    cosine = np.maximum(_least_squares(curve, phasor.real)[1], 0.0)
    misfit = np.sqrt(np.mean((phasor.imag - sine) ** 2 + (phasor.real - cosine) ** 2))
    constant = mean * most / mass if mass > 0 else np.inf
    return _Fit(float(misfit), float(constant), float(cosine.mean()))


def _least_squares(
    columns: Float[np.ndarray, "state term"], values: Float[np.ndarray, " state"]
) -> tuple[float, Float[np.ndarray, " state"]]:
    """The last column's coefficient and the values of the fit."""
    size = np.linalg.norm(columns, axis=0)
    found = np.linalg.lstsq(columns / size, values, rcond=1e-10)[0] / size
    return float(found[-1]), columns @ found


def _in_words(reading: _Reading, size: float, omega: float, positive: bool) -> str:
    """What a reading means; `size` is the modal constant that the data need over the model's."""
    clauses = []
    if reading.conjugated:
        clauses.append(
            "the phases rise through resonance where those of a velocity relative to the force "
            "fall: the phasors seem to be conjugated (time dependence e^(-iΩt)); change the sign "
            "of `velocity_im_m_s`, or import again with the other `--phase-sign`"
        )
    if reading.turn == 1j:
        said = "turn the phases by +90°, or multiply the phasors by iΩ if they are displacements"
        if size < omega**-0.5:
            said = "displacements seem to be given as velocities; multiply the phasors by iΩ"
        clauses.append(f"the phases lie 90° behind those of a velocity: {said}")
    elif reading.turn == -1j:
        said = "turn the phases by -90°, or divide the phasors by iΩ if they are accelerations"
        if size > omega**0.5 and np.isfinite(size):
            said = "accelerations seem to be given as velocities; divide the phasors by iΩ"
        clauses.append(f"the phases lie 90° ahead of those of a velocity: {said}")
    elif reading.turn == -1:
        is_, sign = ("against", "positive") if positive else ("with", "negative")
        clauses.append(
            f"at resonance the velocity is {is_} the force where the model's `shape` times "
            f"`participation` is {sign}: the sensor, the force or the model seems to have the "
            "wrong sign; turn the phases by 180°, or change that sign"
        )
    return "; with that done, ".join(clauses) + "."


Arguments = ParamSpec("Arguments")
Found = TypeVar("Found")


def naming_wrong_phases(verb: Callable[Arguments, Found]) -> Callable[Arguments, Found]:
    """A verb that says first what is wrong with the phases of its data, if anything is.

    In the `notes` of what it returns, or in its `ValueError`.
    """

    @functools.wraps(verb)
    def named(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Found:
        given: tuple[object, ...] = (*args, *kwargs.values())
        data = [one for one in given if isinstance(one, SteadyStates)]
        modes = [one for one in given if isinstance(one, LinearModes | Structure)]
        said = wrong_phases(data[0], modes[0]) if data and modes else ()
        try:
            found: Any = verb(*args, **kwargs)
        except ValueError as error:
            if not said or said[0] in str(error):
                raise
            raise ValueError(f"{said[0]} As the data are: {error}") from error
        if said:
            found = dataclasses.replace(found, notes=(*said, *found.notes))
        return cast(Found, found)

    return named
