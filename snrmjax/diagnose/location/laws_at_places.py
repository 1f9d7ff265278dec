"""Laws of forces at a place, held against the forces that the sensors ask for there."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.optimize import least_squares

from snrmjax.diagnose.location.source_patterns import SensorRecords, SourceFit, SourcePattern
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.model.effect_base import AbstractForce, AbstractHysteresis
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, make_effect
from snrmjax.model.library.friction import AbstractSliders
from snrmjax.numerics.compiled import compiled

_FINE = 1024  # samples of a cycle with jumps of the force
_SAMPLES = 256  # of a cycle
_SECANTS = 8  # towards the mean displacement, by the Illinois method
_STEP = 1e-3  # of the motion, of differences of the force by it
_SMALL = 1e-3  # of 1σ, of differences by the records' errors
_ROUNDING = 1e-9
_ROUNDS = 3  # of fits, the first with all errors independent


class PlacedLaw(NamedTuple):
    """A law along one row."""

    kind: str
    chi_square: float
    freedom: int
    parameters: dict[str, float]
    std: dict[str, float]


class LawAtPlace(NamedTuple):
    """A kind of law along a row: what it leaves of the sensors' records."""

    effect: Any
    names: tuple[str, ...]
    records: SensorRecords
    place: SourcePattern
    free: SourceFit

    def force(
        self, values: np.ndarray, motion: Complex[np.ndarray, "state order"]
    ) -> Complex[np.ndarray, "state order"]:
        """The law's force along motions, at the recorded orders."""
        law = (self.effect, self.names, self.records.orders, jnp.asarray(values))
        at = jnp.asarray(motion), jnp.asarray(self.records.frequency), self.place.static
        return np.asarray(_force(*law, *at))

    def left(self, values: np.ndarray) -> Complex[np.ndarray, "state order sensor"]:
        """What the sensors saw beside the linear response to the measured force and the law's."""
        place, motion = self.place, _displacement(self.records.seen, self.place, self.free)
        given = place.pattern * self.force(values, motion)[..., None]
        return self.records.seen - place.driven + given

    def roots(self, values: np.ndarray) -> Float[np.ndarray, "state entry entry"]:
        """Cholesky factors of the covariances of what is left, by the errors of the records.

        They count directly and by the motion along the row, which turns into the law's force.
        """
        records, place = self.records, self.place
        motion = _displacement(records.seen, place, self.free)
        now, count = self.force(values, motion), len(motion)
        size = _STEP * np.abs(motion[:, :1])
        by_motion = []  # of the force, by real and imaginary part of each order of the motion
        for k in range(motion.shape[1]):
            for part in (1.0, 1j):
                moved = motion.copy()
                moved[:, k] += part * size[:, 0]
                by_motion.append((self.force(values, moved) - now) / size)
        slopes = []
        for unit in np.eye(records.n_inputs):
            erring = records.erring(np.tile(_SMALL * unit, (count, 1))) - records.seen
            moved = place.own * np.sum(self.free.weights * erring, axis=2)
            parts = np.stack([moved.real, moved.imag], axis=2).reshape(count, -1)
            force = np.einsum("sp,pso->so", parts, np.array(by_motion))
            slopes.append(_parts(erring + place.pattern * force[..., None]) / _SMALL)
        slope = np.stack(slopes, axis=2)
        covariance = slope @ slope.swapaxes(1, 2)
        unused = ~self.used
        covariance[unused[:, :, None] | unused[:, None, :]] = 0.0
        trace = np.trace(covariance, axis1=1, axis2=2)[:, None]
        at = np.arange(covariance.shape[1])
        covariance[:, at, at] += np.where(unused, 1.0, _ROUNDING * trace)
        return np.linalg.cholesky(covariance)

    @property
    def used(self) -> np.ndarray:
        """Which real numbers of each state were measured."""
        return np.repeat(self.records.there.reshape(len(self.records.seen), -1), 2, axis=1)

    def scaled_start(self, values: np.ndarray) -> np.ndarray:
        """A start with the strength that brings its force nearest to what each state asks for."""
        motion = _displacement(self.records.seen, self.place, self.free)
        asked = -np.sum(self.free.weights * (self.records.seen - self.place.driven), axis=2)
        given = self.force(values, motion)
        size = np.sum(np.abs(given) ** 2)
        share = np.sum((asked * given.conj()).real) / size if size > 0 else 1.0
        return np.append(values[0] * (share if share > 0 else 1.0), values[1:])


def law_fit(
    kind: str,
    records: SensorRecords,
    place: SourcePattern,
    free: SourceFit,
    *,
    rough: bool = False,
) -> PlacedLaw:
    """The parameters with which a law along a row explains the sensors best.

    The motion along the row is what sensors and linear structure make of it; the law's force along
    that motion, at the recorded orders, must move the sensors as they did. A `rough` fit takes the
    errors of all numbers as independent.
    """
    scales = _scales(records, place, free)
    start = candidate(kind, scales)
    names = tuple(EFFECTS[kind].parameters())
    effect = make_effect(kind, dict(zip(names, start.starts[0], strict=True)))
    law = LawAtPlace(effect, names, records, place, free)
    lower, upper, unit = map(np.array, (start.lower, start.upper, start.unit))
    starts = [np.clip(law.scaled_start(np.array(first)), lower, upper) for first in start.starts]
    flat = 1 / records.std()[..., None]

    def misfit(values: np.ndarray) -> float:
        return float(
            np.sum(np.where(records.there, np.abs(law.left(values) * flat[..., 0]), 0) ** 2)
        )

    values = min(starts, key=misfit)
    for turn in range(1 if rough else _ROUNDS):
        roots = None if turn == 0 else law.roots(values)

        size = np.where(np.abs(values) > 0, np.abs(values), unit)

        def whitened(scaled: np.ndarray, roots: Any = roots, size: Any = size) -> np.ndarray:
            rows = law.left(scaled * size)
            if roots is None:
                return _parts(np.where(records.there, rows * flat[..., 0], 0.0)).reshape(-1)
            parts = np.where(law.used, _parts(rows), 0.0)
            return np.linalg.solve(roots, parts[..., None]).reshape(-1)

        bounds = lower / size, upper / size
        found = least_squares(whitened, values / size, bounds=bounds, max_nfev=30, xtol=1e-6)
        values = found.x * size
    spread = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac))) * size
    return PlacedLaw(
        kind,
        2 * float(found.cost),
        int(law.used.sum()) - len(names),
        dict(zip(names, values.tolist(), strict=True)),
        dict(zip(names, spread.tolist(), strict=True)),
    )


def _parts(rows: Complex[np.ndarray, "state order sensor"]) -> Float[np.ndarray, "state entry"]:
    return np.stack([rows.real, rows.imag], axis=-1).reshape(len(rows), -1)


def _displacement(
    seen: Complex[np.ndarray, "state order sensor"], place: SourcePattern, free: SourceFit
) -> Complex[np.ndarray, "state order"]:
    """Along the row, by the forces that explain each state best."""
    force = np.sum(free.weights * (seen - place.driven), axis=2)
    return place.own_driven + place.own * force


def _scales(records: SensorRecords, place: SourcePattern, free: SourceFit) -> MotionScales:
    """Typical sizes along the row; as stiffness what the forces there are over the motion."""
    force = np.abs(np.sum(free.weights * (records.seen - place.driven), axis=2))[:, 0]
    amplitude = np.abs(_displacement(records.seen, place, free)[:, 0])
    omega = float(np.median(records.frequency))
    stiffness = float(np.median(force / amplitude))
    return MotionScales(
        amplitude=float(np.median(amplitude)),
        largest=float(np.max(amplitude)),
        frequency=omega,
        stiffness=stiffness,
        receptance=1 / stiffness,
        smallest_force=float(np.min(force)),
        damping_ratio=stiffness / (2 * omega**2),
    )


@compiled
def _force(
    effect: AbstractForce,
    names: tuple[str, ...],
    orders: tuple[int, ...],
    values: Float[Array, " parameter"],
    motion: Complex[Array, "state order"],
    frequency: Float[Array, " state"],
    static: Float[Array, ""],
) -> Complex[Array, "state order"]:
    """Some harmonics of a law's force along motions whose mean is what that force itself makes."""
    law = dataclasses.replace(effect, **dict(zip(names, values, strict=True)))
    jumps = isinstance(effect, AbstractHysteresis) and not isinstance(effect, AbstractSliders)
    n_samples = _FINE if jumps else _SAMPLES
    tau, order = 2 * np.pi * np.arange(n_samples) / n_samples, np.array(orders)
    turn = jnp.exp(1j * order[:, None] * tau)

    def one(x: Array, omega: Array) -> Array:
        wave, rate = (x @ turn).real, ((1j * order * omega * x) @ turn).real
        far = jnp.max(jnp.abs(wave))

        def along(mean: Array) -> Array:
            return law.cycle_force(wave + mean, jnp.asarray(rate))

        def missed(mean: Array) -> Array:
            return mean + static * jnp.mean(along(mean))

        def nearer(_: int, ends: tuple[Array, ...]) -> tuple[Array, ...]:
            low, high, at_low, at_high = ends
            share = at_low / jnp.where(at_low == at_high, 1.0, at_low - at_high)
            middle = low + share * (high - low)
            at = missed(middle)
            same = at * at_high > 0  # of the end that stays the weight is halved
            return (
                jnp.where(same, low, high),
                middle,
                jnp.where(same, 0.5 * at_low, at_high),
                at,
            )

        ends = -far, far, missed(-far), missed(far)
        _, mean, *_ = jax.lax.fori_loop(0, _SECANTS, nearer, ends)
        return jnp.fft.rfft(along(mean))[order] * 2 / n_samples

    return jax.vmap(one)(motion, frequency)
