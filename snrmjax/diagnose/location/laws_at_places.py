"""Laws of forces at a place, held against the forces that the sensors ask for there."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import least_squares

from snrmjax.diagnose.location.element_motion import (
    JUMP_ORDERS,
    OWN_ORDERS,
    ElementForces,
    SurroundedElement,
    element_forces,
    force_along,
)
from snrmjax.diagnose.location.source_patterns import SensorRecords, SourceFit, SourcePattern
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, make_effect
from snrmjax.model.library.friction import CoulombFriction

_SMALL = 1e-3  # of 1σ, of differences by the records' errors
_ROUNDING = 1e-9
_ROUNDS = 6  # of fits at most, the first with all errors independent
_STILL = 0.05  # of 1σ, by which parameters may still change from round to round
_ROUGH = 8  # evaluations of a rough fit
_TRIALS = 40  # of any other


class PlacedLaw(NamedTuple):
    """A law along one row; `std` is NaN where a fit has not converged or determines too little."""

    kind: str
    chi_square: float
    freedom: int
    parameters: dict[str, float]
    std: dict[str, float]

    @property
    def determined(self) -> bool:
        """Whether the parameters are the best ones, with a motion for every state, and have 1σ."""
        return bool(np.all(np.isfinite(list(self.std.values()))))


class LawAtPlace:
    """A kind of law along a row: what it leaves of the sensors' records.

    The fundamental of the motion along the row is what sensors and linear structure make of it;
    its other harmonics are the element's own. Those of one trial are where the next one starts.
    Jumps of a force are resolved where it is not to be `rough`.
    """

    def __init__(
        self,
        kind: str,
        records: SensorRecords,
        place: SourcePattern,
        free: SourceFit,
        rough: bool,
    ):
        self.records, self.place, self.free = records, place, free
        self.scales = _scales(records, place, free)
        self.start = candidate(kind, self.scales)
        names = tuple(EFFECTS[kind].parameters())
        self.effect: Any = make_effect(kind, dict(zip(names, self.start.starts[0], strict=True)))
        jumps = kind == CoulombFriction.kind and not rough
        own = place.own[:, : 1 + max(JUMP_ORDERS if jumps else OWN_ORDERS, *records.orders)]
        motion = np.zeros_like(own)
        motion[:, 1] = _fundamental(records, place, free)[1]
        self.first = SurroundedElement(records.frequency, own, motion)
        self._near = self.first
        self._last: tuple[np.ndarray, ElementForces | None] = (np.zeros(0), None)

    def forces(self, values: np.ndarray, *, exact: bool = False) -> ElementForces:
        """The law's forces with its own motion; `exact` slopes belong to covariances."""
        known, found = self._last
        if found is not None and np.array_equal(known, values) and not exact:
            return found
        found = element_forces(self.effect, values, self._near, exact=exact)
        lost = ~found.settled
        if lost.any():  # from a sinusoidal motion, in place of another law's
            again = element_forces(self.effect, values, self.first)
            better = lost & again.settled
            found = ElementForces(
                *(
                    np.where(better.reshape(-1, *(1,) * (one.ndim - 1)), two, one)
                    for one, two in zip(found, again, strict=True)
                )
            )
        if found.settled.all():
            self._near = self._near._replace(motion=found.motion, slopes=found.slopes)
        self._last = values.copy(), found
        return found

    def _along_sinusoids(self, values: np.ndarray) -> Complex[np.ndarray, "state order"]:
        return force_along(self.effect, values, self.first)[:, list(self.records.orders)]

    def left(self, values: np.ndarray) -> Complex[np.ndarray, "state order sensor"]:
        """What the sensors saw beside the linear response to the measured force and the law's."""
        force = self.forces(values).force[:, list(self.records.orders)]
        return self.records.seen - self.place.driven + self.place.pattern * force[..., None]

    def slopes(self, values: np.ndarray) -> Complex[np.ndarray, "state order sensor parameter"]:
        """Slopes of what is left by the parameters."""
        by = self.forces(values).by_parameter[:, list(self.records.orders)]
        return self.place.pattern[..., None] * by[:, :, None]

    def roots(self, values: np.ndarray) -> Float[np.ndarray, "state entry entry"]:
        """Cholesky factors of the covariances of what is left, by the errors of the records.

        They count directly and by the fundamental along the row, which turns into the law's force.
        """
        records, place, count = self.records, self.place, len(self.records.seen)
        by_motion = self.forces(values, exact=True).by_motion[:, list(records.orders)]
        slopes = []
        for unit in np.eye(records.n_inputs):
            erring = records.erring(np.tile(_SMALL * unit, (count, 1))) - records.seen
            moved = place.own[:, 1] * np.sum(self.free.weights * erring, axis=2)[:, 0]
            parts = np.stack([moved.real, -moved.imag], axis=1)
            force = np.einsum("sp,sop->so", parts, by_motion)
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
        asked = -np.sum(self.free.weights * (self.records.seen - self.place.driven), axis=2)
        given = self._along_sinusoids(values)
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

    The fundamental along the row is what sensors and linear structure make of it; the law's force
    along the motion that the element has with it must move the sensors as they did. A `rough` fit
    takes the errors of all numbers as independent and ends early. Others go on until parameters
    and covariances belong to each other.
    """
    law = LawAtPlace(kind, records, place, free, rough)
    start = law.start
    lower, upper, unit = map(np.array, (start.lower, start.upper, start.unit))
    starts = [np.clip(law.scaled_start(np.array(first)), lower, upper) for first in start.starts]
    flat = np.where(records.there, 1 / records.std(), 0.0)

    def whitened(parts: np.ndarray, roots: np.ndarray | None) -> np.ndarray:
        """Rows (state, order, sensor, column) in units of noise."""
        rows = parts.reshape(*records.seen.shape, -1)
        if roots is None:
            return _columns(rows * flat[..., None]).reshape(law.used.size, -1)
        rows = np.where(law.used[..., None], _columns(rows), 0.0)
        return np.linalg.solve(roots, rows).reshape(law.used.size, -1)

    values = min(starts, key=lambda at: float(np.sum(whitened(law.left(at), None) ** 2)))
    still, spread = False, np.full(len(values), np.nan)
    for turn in range(1 if rough else _ROUNDS):
        roots = None if turn == 0 else law.roots(values)
        size = np.where(np.abs(values) > 0, np.abs(values), unit)
        found = least_squares(
            lambda scaled, roots=roots, size=size: whitened(law.left(scaled * size), roots)[:, 0],
            values / size,
            lambda scaled, roots=roots, size=size: (
                whitened(law.slopes(scaled * size), roots) * size
            ),
            bounds=(lower / size, upper / size),
            max_nfev=_ROUGH if rough else _TRIALS,
            xtol=1e-6,
        )
        before, values = values, found.x * size
        spread = _spread(found.jac) * size
        still = bool(np.all(np.abs(values - before) <= _STILL * spread))
        if turn > 0 and still and found.status > 0:
            break
    done = still and found.status > 0 and bool(np.all(law.forces(values).settled))
    names = EFFECTS[kind].parameters()
    return PlacedLaw(
        kind,
        2 * float(found.cost),
        int(law.used.sum()) - len(names),
        dict(zip(names, values.tolist(), strict=True)),
        dict(zip(names, np.where(done, spread, np.nan).tolist(), strict=True)),
    )


def _spread(slopes: Float[np.ndarray, "row parameter"]) -> Float[np.ndarray, " parameter"]:
    """1σ of every parameter; NaN where the rows do not determine all of them."""
    if np.linalg.matrix_rank(slopes) < slopes.shape[1]:
        return np.full(slopes.shape[1], np.nan)
    return np.asarray(np.linalg.norm(np.linalg.pinv(slopes), axis=1))


def _parts(rows: Complex[np.ndarray, "state order sensor"]) -> Float[np.ndarray, "state entry"]:
    return _columns(rows[..., None])[..., 0]


def _columns(
    rows: Complex[np.ndarray, "state order sensor column"],
) -> Float[np.ndarray, "state entry column"]:
    parts = np.stack([rows.real, rows.imag], axis=3)
    return parts.reshape(len(rows), -1, rows.shape[-1])


def _fundamental(
    records: SensorRecords, place: SourcePattern, free: SourceFit
) -> tuple[Complex[np.ndarray, " state"], Complex[np.ndarray, " state"]]:
    """Of the force along the row that explains each state best, and of the motion with it."""
    force = np.sum(free.weights[:, 0] * (records.seen - place.driven)[:, 0], axis=1)
    return force, place.own_driven + place.own[:, 1] * force


def _scales(records: SensorRecords, place: SourcePattern, free: SourceFit) -> MotionScales:
    """Typical sizes along the row; as stiffness what the forces there are over the motion."""
    force, amplitude = map(np.abs, _fundamental(records, place, free))
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
