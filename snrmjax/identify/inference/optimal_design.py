"""Optimal design: the steady states that narrow a band most."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.identify.inference.contributions import AbstractTable
from snrmjax.identify.inference.fitted_curves import values_at_displacement
from snrmjax.identify.inference.fitted_response import FittedResponse, fitted_response
from snrmjax.identify.joint.force_balance import (
    BalanceData,
    BalanceProblem,
    filled,
    no_errors,
    relative_participation,
)
from snrmjax.identify.joint.free_unknowns import packed_unknowns, padded_levels, whitened_slopes
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.snrm import sensed_mode
from snrmjax.identify.test_model.balance import off_resonance
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.numerics.blocks import padded
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import Variable, setting
from snrmjax.numerics.units import HERTZ

Target = Literal["curves", "frequency", "damping"]

_CURVES = ("natural frequency", "damping")
_SHOWN = 12  # advised states on one screen
_PER_FORCE = 96  # candidate states of one force
_TARGETS = 25  # amplitudes at which a band is evaluated
_FROM_FOLD = 0.002  # smallest relative frequency distance of a state from a fold
_FARTHEST = np.radians(70.0)  # from resonance: beyond it other errors dominate


class NextMeasurement(NamedTuple):
    """One advised steady state."""

    rank: int
    force: float  # N; by the fitted gain where only the drive is known
    frequency: float  # rad/s
    velocity: float  # m/s, expected
    phase: float  # rad, expected of the velocity relative to the force
    expected_band_ratio: float  # mean band after this and the preceding states, over the present
    reason: Fact
    drive: float | None = None  # V, where only the drive is known

    @property
    def expected(self) -> str:
        """The expected velocity and its phase in words."""
        degrees = round(float(np.degrees(self.phase)))
        side = f"{abs(degrees)}° {'lead' if degrees > 0 else 'lag'}" if degrees else "resonance"
        return f"{self.velocity:.3g} m/s, {side}"


class NextMeasurements(AbstractTable[NextMeasurement]):
    """Advised steady states, the best first; a sequence of `NextMeasurement`."""

    coordinates = ("rank",)
    columns: ClassVar = {
        "rank": (lambda row: row.rank, "1", "rank, the best first"),
        "force_n": (lambda row: row.force, "N", "force"),
        "drive_v": (lambda row: row.drive, "V", "drive voltage"),
        "frequency_hz": (lambda row: row.frequency / HERTZ, "Hz", "frequency"),
        "velocity_m_s": (lambda row: row.velocity, "m/s", "expected velocity"),
        "phase_deg": (lambda row: np.degrees(row.phase), "deg", "phase"),
        "expected_band_ratio": (
            lambda row: row.expected_band_ratio,
            *("1", "mean band after it, over the present one"),
        ),
        "reason": (lambda row: str(row.reason), "", "why this state"),
    }

    responses: tuple[FittedResponse, ...]  # the main curves under the advised forces
    sensor: str = setting()
    target: str = setting()
    status: Fact = setting()
    drive_known_only: bool = eqx.field(static=True)
    notes: tuple[Fact, ...] = setting(default=())

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        lines = [f"NextMeasurements: {len(self)} states that narrow the band of {self.target} most"]
        for row in self.rows[:_SHOWN]:
            load = f"force {row.force:.4g} N" if row.drive is None else f"drive {row.drive:.4g} V"
            state = f"{load}, {row.frequency / HERTZ:.6g} Hz (expected {row.expected})"
            lines.append(f"{row.rank}: {state}: {row.reason}")
        if len(self) > _SHOWN:
            lines.append(f"and {len(self) - _SHOWN} more")
        if self.status.kind != "advice_complete":
            lines.append(f"status: {self.status}")
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """Those of the rows, with either the force or the drive."""
        left_out = "force_n" if self.drive_known_only else "drive_v"
        return {
            name: variable for name, variable in super().variables().items() if name != left_out
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {**super().attributes(), "status": str(self.status)}


@on_numbers("Differentiate `sj.identify.refit`.")
def next_measurements(
    fit: JointFit,
    count: int,
    *,
    target: Target = "curves",
    forces: Sequence[float] | Float[np.ndarray, " force"] | None = None,
    from_frequency: float = 0.0,
    to_frequency: float = np.inf,
) -> NextMeasurements:
    """Rank steady states by how much they narrow a band, each given the preceding ones.

    Candidates are the stable states of the fitted responses within 70° of resonance, except
    isolated branches, which no sweep reaches, states within 0.2 % of a fold, where a test jumps,
    and extrapolated amplitudes. Every force is a new level with its own errors. The expected
    information comes from the force balance linearised at the state, with the fit's noise and
    level-error 1σ; where the latter is estimated, a new level improves it too, and the band narrows
    more than expected. Bands are conditional on the chosen families.

    Arguments: `target` is the band to narrow: of both curves (relative), of natural frequency or
    damping alone; `forces` in N, or in V where only the drive is known, by default twelve from the
    smallest to the largest measured; frequencies in rad/s.
    Returns at most `count` states, fewer or none where no more can be measured (`status`); `notes`
    report a fit that has not converged.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    Reference: greedy sequential design, Fedorov, Theory of Optimal Experiments (1972), here for a
    mean of standard deviations.
    """
    measured = np.asarray(fit.motion().force)
    wanted = np.geomspace(measured.min(), measured.max(), 12)
    if forces is not None:
        given = np.asarray(forces, dtype=np.float64)
        wanted = fit.force_of_drive(given) if fit.drive_known_only else given
    states = _candidates(fit, [float(f) for f in wanted], (from_frequency, to_frequency))
    slopes, scale = _target(fit, target)
    advice = [] if states is None else _ranked(fit, states, slopes / scale[:, None], target, count)
    loads = {row.force for row in advice}
    enough = len(advice) == count
    status = Fact("advice_complete") if enough else Fact("fewer_candidates")
    return NextMeasurements(
        rows=tuple(advice),
        responses=() if states is None else tuple(c for c in states.curves if c.force in loads),
        sensor=fit.modes.sensors[fit.data.sensor],
        target=target,
        status=status if states is not None else Fact("no_state_to_measure"),
        drive_known_only=fit.drive_known_only,
        notes=() if fit.converged else (Fact("advice_of_unconverged_fit"),),
    )


def _ranked(
    fit: JointFit,
    states: "_States",
    slopes: Float[np.ndarray, "output unknown"],
    target: Target,
    count: int,
) -> list[NextMeasurement]:
    """The best states by greedy selection; `slopes` of the target quantities."""
    rows = _information(fit, states)
    p, n_levels = fit.covariance.shape[0], rows.shape[2] - fit.covariance.shape[0]
    covariance = np.zeros((p + n_levels, p + n_levels))
    covariance[:p, :p] = fit.covariance
    covariance[p:, p:] = np.eye(n_levels)
    slopes = np.pad(slopes, ((0, 0), (0, n_levels)))
    before = _mean_band(slopes, covariance)
    advice: list[NextMeasurement] = []
    open_states = np.ones(len(states.frequency), dtype=bool)
    for rank in range(1, count + 1):
        if not open_states.any():
            break
        best, variance = _best(slopes, covariance, rows, open_states)
        old = np.einsum("op,pq,oq->o", slopes, covariance, slopes)
        sensitivity = rows[best] @ covariance
        covariance = covariance - sensitivity.T @ np.linalg.solve(
            np.eye(2) + sensitivity @ rows[best].T, sensitivity
        )
        open_states[best] = False
        force = float(states.force[best])
        drive = float(fit.recorded_force(states.force[best]))
        advice.append(
            NextMeasurement(
                rank=rank,
                force=force,
                frequency=float(states.frequency[best]),
                velocity=float(abs(states.velocity[best])),
                phase=float(np.angle(states.velocity[best])),
                expected_band_ratio=float(_mean_band(slopes, covariance) / before),
                reason=_reason(target, old, variance),
                drive=drive if fit.drive_known_only else None,
            )
        )
    return advice


class _States(NamedTuple):
    level: np.ndarray
    force: np.ndarray
    frequency: np.ndarray
    velocity: Complex[np.ndarray, " state"]
    curves: tuple[FittedResponse, ...]  # that the states lie on


def _candidates(fit: JointFit, forces: list[float], ends: tuple[float, float]) -> _States | None:
    rows, drawn = [], []
    for number, force in enumerate(forces):
        curves = fitted_response(fit, force, from_frequency=ends[0], to_frequency=ends[1])
        for curve in curves[:1]:
            drawn.append(curve)
            keep = _measurable(fit, curve)
            at = np.flatnonzero(keep)
            if at.size > _PER_FORCE:
                at = at[np.linspace(0, at.size - 1, _PER_FORCE).astype(int)]
            rows.append(
                (
                    *(np.full(at.size, number), np.full(at.size, force)),
                    *(curve.frequency[at], curve.velocity[at]),
                )
            )
    if not rows or not sum(len(row[0]) for row in rows):
        return None
    level, load, frequency, velocity = (np.concatenate(c) for c in zip(*rows, strict=True))
    return _States(level, load, frequency, velocity, tuple(drawn))


def _measurable(fit: JointFit, curve: FittedResponse) -> np.ndarray:
    # Phase of the velocity relative to the modal force.
    sensor, sign = fit.data.sensor, np.sign(float(fit.problem.modal_constant))
    to_mode = np.asarray(sensed_mode(fit.modes, curve.frequency).to_mode(sensor))
    phase = np.angle(sign * curve.velocity * to_mode)
    keep = curve.stable & ~curve.continued & (np.abs(phase) < _FARTHEST)
    for fold in curve.folds:
        keep &= np.abs(curve.frequency / fold.frequency - 1) > _FROM_FOLD
    return keep & np.isfinite(curve.frequency)


def _target(
    fit: JointFit, target: Target
) -> tuple[Float[np.ndarray, "output unknown"], Float[np.ndarray, " output"]]:
    """Slopes of the target quantities, and the values that their bands are relative to."""
    measured = np.asarray(fit.motion().displacement)
    at = np.linspace(measured.min(), measured.max(), _TARGETS)
    values, slopes, *_ = values_at_displacement(fit, at)
    parts = {"frequency": [0], "damping": [1]}.get(target, [0, 1])
    each = [slopes[:, k] / (2.0 if k == 0 else 1.0) for k in parts]
    return np.concatenate(each), np.concatenate([values[:, k] for k in parts])


def _information(fit: JointFit, states: _States) -> Float[np.ndarray, "state part unknown"]:
    """Whitened slopes of every candidate's balance, by the unknowns and by new levels' errors."""
    n, n_levels = len(states.force), int(states.level.max()) + 1
    std = np.median(np.asarray(fit.data.std), axis=0)
    sensor, sensed = fit.data.sensor, sensed_mode(fit.modes, states.frequency)
    fraction = np.zeros((n, fit.data.fraction.shape[1]), dtype=fit.data.fraction.dtype)
    fraction[:, sensor] = sensed.to_mode(sensor) if np.iscomplexobj(fraction) else 1.0
    phase = np.exp(1j * float(fit.unknowns.instrument_phase))
    constant = float(fit.problem.constant_of(fit.unknowns))
    z = 1j * states.frequency * constant * states.force / states.velocity
    data = BalanceData(
        level=jnp.asarray(states.level),
        frequency=jnp.asarray(states.frequency),
        force=jnp.asarray(fit.recorded_force(states.force)),
        velocity=jnp.asarray(states.velocity * fraction[:, sensor] * phase),
        fraction=jnp.asarray(fraction),
        participation=jnp.asarray(relative_participation(fit.modes, states.frequency)),
        std=jnp.broadcast_to(jnp.asarray(std), (n, len(std))),
        weight=jnp.ones(n),
        correction=jax.device_put(no_errors(n)),
        detuning=jax.device_put(off_resonance(z, states.frequency)),
        n_levels=n_levels,
        sensor=fit.data.sensor,
    )
    n_padded, room = len(padded(states.frequency)), padded_levels(n_levels)
    padded_states = jax.tree.map(lambda rows: filled(rows, n_padded, None), data)
    levels = dataclasses.replace(padded_states, n_levels=room)
    of_new = dataclasses.replace(fit.prior, level=fit.prior.new_level)
    problem = BalanceProblem(levels, fit.modes, of_new)
    # New levels replace the fit's, which are independent of them.
    new = np.zeros((n_levels, len(LEVEL_ERRORS)))
    unknowns = eqx.tree_at(lambda u: u.level, fit.unknowns, new)
    slopes, _ = whitened_slopes(packed_unknowns(unknowns, fit.free, room), problem, n)
    n_linear = len(unknowns.linear)
    first, of_levels, last = np.split(slopes, [-n_linear - new.size, -n_linear], axis=2)
    nothing = np.zeros((n, 2, fit.unknowns.level.size))
    return np.concatenate([first, nothing, last, of_levels], axis=2)


def _mean_band(slopes: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.mean(np.sqrt(np.einsum("op,pq,oq->o", slopes, covariance, slopes))))


def _best(
    slopes: np.ndarray, covariance: np.ndarray, rows: np.ndarray, wanted: np.ndarray
) -> tuple[int, np.ndarray]:
    """The candidate with the smallest remaining mean band, and the remaining variances."""
    index = np.flatnonzero(wanted)
    candidates = rows[index]
    through = candidates @ covariance  # (state, part, unknown)
    inner = np.eye(2) + through @ candidates.transpose(0, 2, 1)
    sensitivities = through @ slopes.T  # (state, part, output)
    gain = np.einsum("sio,sio->so", sensitivities, np.linalg.solve(inner, sensitivities))
    variance = np.einsum("op,pq,oq->o", slopes, covariance, slopes)
    remaining = np.maximum(variance - gain, 0.0)
    best = int(np.argmin(np.mean(np.sqrt(remaining), axis=1)))
    return int(index[best]), remaining[best]


def _reason(target: Target, before: np.ndarray, after: np.ndarray) -> Fact:
    """Which band narrows, and by what fraction."""
    narrowed = 1 - np.sqrt(after / before)
    if target == "curves":
        fractions = dict(
            zip(_CURVES, np.mean(narrowed.reshape(2, -1), axis=1).tolist(), strict=True)
        )
        curve = max(fractions, key=lambda name: fractions[name])
        return Fact("band_narrower", curve=curve, fraction=fractions[curve])
    curve = _CURVES[target == "damping"]
    return Fact("band_narrower", curve=curve, fraction=float(np.mean(narrowed)))
