"""Check whether recorded phasors are velocities relative to the force, or something else."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import jax
import numpy as np
from jaxtyping import Float

from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_LEAST_STATES = 6
_NEAR = 0.2  # of a level's largest |V|/F, for a state to count as near resonance
_POWERS = (0, 2, -1, 4, 1)  # of the amplitude, in the curves of stiffness and damping
_PER_TERM = 5  # states per power
_WRONG, _RIGHT = (
    0.25,
    0.15,
)  # relative misfit of the phasors: least as given, largest as interpreted
_DAMPED = 0.25  # least mean cosine of the phase near resonance, of another interpretation
_BETTER, _AS_GOOD = (
    3.0,
    1.5,
)  # ratios of misfits: to prefer another interpretation; to count as equal
_WRONG_SCALE = 10.0  # ratio of modal constants beyond any amplitude dependence


class _Interpretation(NamedTuple):
    """The velocity that recorded phasors V may represent: i^n V, or i^n V* if conjugated."""

    conjugated: bool
    quarter_turns: int  # n


_INTERPRETATIONS = tuple(
    _Interpretation(conjugated, n) for conjugated in (False, True) for n in (0, 1, -1, 2)
)


class _NearResonance(NamedTuple):
    """States of the sensor with the largest shape, with the sign of the model's mode there."""

    phase: Float[np.ndarray, " state"]  # rad, of V relative to the force and that sign
    mobility: Float[np.ndarray, " state"]  # |V|/F
    frequency: Float[np.ndarray, " state"]  # rad/s
    amplitude: Float[np.ndarray, " state"]  # over the largest


class _Fit(NamedTuple):
    """A single mode fitted to the phasors under one interpretation."""

    misfit: float  # relative, rms
    constant: float  # 1/m, the modal constant
    cosine: float  # mean of cos φ


def wrong_phases(data: SteadyStates, modes: LinearModes | Structure) -> tuple[Fact, ...]:
    """Detect measured phases that are clearly not those of a velocity relative to the force.

    Near resonance a single mode has F cos φ = d(a)|V| and ΩF sin φ = (k(a) − mΩ²)|V|, with m and
    d(a) positive and smooth functions of the amplitude a. Both are fitted by linear least squares
    to the phases as given and to seven other interpretations: conjugated, rotated by ±90°
    (displacement or acceleration in place of velocity) or 180° (sign of a sensor or of the force),
    and both. If the phases as given clearly do not fit and another interpretation clearly does,
    that one is named, or all that fit equally well.

    Arguments: `data` measured states, `modes` whose shape and participation give the sign of the
    velocity at resonance. Returns no fact or one. Not differentiable.
    Validity: one resonance; states on both sides of it, otherwise conjugation is not detected.
    """
    modes = modes_of(modes)
    if isinstance(data.velocity, jax.core.Tracer) or data.sensors != modes.sensors:
        return ()
    j = modes.mode_of_interest
    shape = np.asarray(modes.mode_shape)[:, j]
    r = int(np.argmax(np.abs(shape)))
    constant = float(shape[r]) * modes.participation.item(j)
    near = _near_resonance(data, r, constant)
    if near is None:
        return ()
    fits = [_fitted(near, one) for one in _INTERPRETATIONS]
    misfit = np.array([fits[0].misfit, *(_of_a_damped_mode(fit) for fit in fits[1:])])
    best = float(misfit.min())
    known = bool(np.any(np.isfinite(np.asarray(data.force))))
    if best > _RIGHT or misfit[0] < max(_WRONG, _BETTER * best):
        return _wrong_scale(near, fits[0], abs(constant)) if known else ()
    alike = [_INTERPRETATIONS[k] for k in np.flatnonzero(misfit <= _AS_GOOD * best)]
    fractions = {"as_given": float(misfit[0]), "read_so": best}
    if len(alike) > 1:
        return (Fact("phases_misread_alike", readings=tuple(map(tuple, alike)), **fractions),)
    ratio = fits[_INTERPRETATIONS.index(alike[0])].constant / abs(constant) if known else np.nan
    omega, turns = float(near.frequency.mean()), alike[0].quarter_turns
    # Displacements or accelerations in place of velocities change the constant by a factor ω.
    instead = ""
    if turns == 1 and ratio < omega**-0.5:
        instead = "displacement"
    elif turns == -1 and omega**0.5 < ratio < np.inf:
        instead = "acceleration"
    same_sign = constant > 0
    return (
        Fact(
            "phases_misread",
            **alike[0]._asdict(),
            instead=instead,
            same_sign=same_sign,
            **fractions,
        ),
    )


def _wrong_scale(near: _NearResonance, fit: _Fit, constant: float) -> tuple[Fact, ...]:
    """Detect a ratio of velocity to force far from that of the model's modal mass.

    Only with states away from resonance: at resonance any modal mass fits.
    """
    ratio = fit.constant / constant
    if fit.misfit > _RIGHT or not np.isfinite(ratio) or 1 / _WRONG_SCALE < ratio < _WRONG_SCALE:
        return ()
    with_given_mass = _fitted(
        near, _INTERPRETATIONS[0], mass=near.frequency.mean() * near.mobility.max() / constant
    )
    if with_given_mass.misfit < max(_WRONG, _BETTER * fit.misfit):
        return ()
    return (
        Fact(
            "velocity_over_force_off",
            ratio=float(ratio),
            as_given=with_given_mass.misfit,
            with_own_mass=fit.misfit,
        ),
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
    """The misfit, infinite without visible damping: far from resonance any phases fit."""
    return fit.misfit if fit.cosine > _DAMPED else np.inf


def _fitted(
    near: _NearResonance, interpretation: _Interpretation, mass: float | None = None
) -> _Fit:
    phasor = np.exp(1j * near.phase)
    phasor = 1j**interpretation.quarter_turns * (
        phasor.conj() if interpretation.conjugated else phasor
    )
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
    if mass <= 0:  # impossible for a mode
        mass, sine = 0.0, _least_squares(stiffness, phasor.imag)[1]
    cosine = np.maximum(_least_squares(curve, phasor.real)[1], 0.0)
    misfit = np.sqrt(np.mean((phasor.imag - sine) ** 2 + (phasor.real - cosine) ** 2))
    constant = mean * most / mass if mass > 0 else np.inf
    return _Fit(float(misfit), float(constant), float(cosine.mean()))


def _least_squares(
    columns: Float[np.ndarray, "state term"], values: Float[np.ndarray, " state"]
) -> tuple[float, Float[np.ndarray, " state"]]:
    """The last column's coefficient and the values of the fit."""
    norm = np.linalg.norm(columns, axis=0)
    coefficients = np.linalg.lstsq(columns / norm, values, rcond=1e-10)[0] / norm
    return float(coefficients[-1]), columns @ coefficients


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class MisreadPhases(InputError):
    """Rejection of data with wrong phases by an analysis; `facts` are those of `wrong_phases`."""

    def __init__(self, facts: tuple[Fact, ...], reason: InputError) -> None:
        super().__init__(f"{facts[0]} As the data are: {reason}")
        self.facts = facts


def naming_wrong_phases(
    *, data: str, modes: str
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Decorate an analysis to report wrong phases of its data first.

    In the `notes` of its result, or by `MisreadPhases` in place of its refusal.
    Arguments: names of the analysis' parameters, with the states and with the modes or structure.
    """

    def of(verb: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(verb)

        @functools.wraps(verb)
        def named(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            given = signature.bind(*args, **kwargs).arguments
            wrong = wrong_phases(given[data], given[modes])
            try:
                result: Any = verb(*args, **kwargs)
            except MisreadPhases:  # raised by a nested analysis
                raise
            except InputError as error:
                if wrong:
                    raise MisreadPhases(wrong, error) from error
                raise
            if wrong:
                result = dataclasses.replace(result, notes=(*wrong, *result.notes))
            return cast(Result, result)

        return named

    return of
