"""Laws of forces at a place, held against the forces that the sensors ask for there."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float
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
from snrmjax.diagnose.location.stuck_friction import held_forces
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, make_effect
from snrmjax.model.library.friction import CoulombFriction

_SMALL = 1e-3  # of 1σ, of differences by the records' errors
_ROUNDING = 1e-9
_ROUNDS = 6  # of fits at most, the first with all errors independent
_STILL = 0.05  # of 1σ, by which parameters may still change from round to round
_RETRIES = 3  # from what the sensors tell, of a state whose motion is not found
_TOLD = 3.0  # 1σ, below which a motion may be none
_ROUGH = 8  # evaluations of a rough fit
_TRIALS = 40  # of any other round
_ALL_TRIALS = 60  # from one start
_STARTS = 3  # of a law that does not fit from the first
_OUTLYING = 3.0  # 1σ, beyond which numbers count little: ρ(r) = 9 log(1 + r²/9)
_OF_NOISE = 0.8741  # mean of ρ of a normal number
_AS_NOISE = 1.2  # times the noise, up to which a law leaves no more than that


class PlacedLaw(NamedTuple):
    """A law along one row; `std` is NaN where a fit has not converged or determines too little."""

    kind: str
    chi_square: float
    freedom: int
    parameters: dict[str, float]
    std: dict[str, float]

    @property
    def fits(self) -> bool:
        """Whether it leaves no more than noise."""
        return self.chi_square < _AS_NOISE**2 * self.freedom

    @property
    def determined(self) -> bool:
        """Whether the parameters are the best ones, with a motion for every state, and have 1σ."""
        return bool(np.all(np.isfinite(list(self.std.values()))))


class LawAtPlace:
    """A kind of law along a row: what it leaves of the sensors' records.

    The fundamental of the motion along the row is what sensors and linear structure make of it;
    its other harmonics are the element's own. Those of one trial are where the next one starts.
    Jumps of a force are resolved where it is not to be `rough`. Dry friction holds in states in
    which the sensors tell no motion.
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
        self.rough = rough
        self.scales = _scales(records, place, free)
        self.start = candidate(kind, self.scales)
        names = tuple(EFFECTS[kind].parameters())
        self.effect: Any = make_effect(kind, dict(zip(names, self.start.starts[0], strict=True)))
        friction = kind == CoulombFriction.kind
        jumps = friction and not rough
        own = place.own[:, : 1 + max(JUMP_ORDERS if jumps else OWN_ORDERS, *records.orders)]
        motion = np.zeros_like(own)
        told = _told_motion(records, place, free)
        motion[:, list(records.orders)] = np.where(told.there, told.motion, 0.0)
        motion[:, 1] = told.motion[:, 0]
        self.first = SurroundedElement(records.frequency, own, motion)
        self._asked = -told.force[:, 0]
        self._held = ~told.there[:, 0] & friction
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget the motions found so far: the next ones start from what the sensors tell."""
        self._near: SurroundedElement | None = None
        self._tried = np.zeros(len(self.records.seen), dtype=int)
        self._last: tuple[np.ndarray, ElementForces | None] = (np.zeros(0), None)

    def forces(self, values: np.ndarray, *, exact: bool = False) -> ElementForces:
        """The law's forces with its own motion; `exact` slopes belong to covariances."""
        known, found = self._last
        if found is not None and np.array_equal(known, values) and not exact:
            return found
        moving = ~self._held
        if moving.all():
            found = self._moving_forces(values, moving, exact)
        else:
            found = held_forces(float(values[0]), self._asked, self.first)
            if moving.any():
                found = found.with_states(moving, self._moving_forces(values, moving, exact))
        self._last = values.copy(), found
        return found

    def _moving_forces(
        self, values: np.ndarray, moving: Bool[np.ndarray, " state"], exact: bool
    ) -> ElementForces:
        """Forces in states that move, each from where it was last found."""
        first = self.first.of(moving)
        near = first if self._near is None else self._near
        found = element_forces(self.effect, values, near, rough=self.rough, exact=exact)
        # From the motion that the sensors tell, in place of another law's; but not for ever.
        tried = self._tried[moving]
        lost = ~found.settled & (tried < _RETRIES)
        if self._near is not None and lost.any():
            again = element_forces(self.effect, values, first.of(lost), rough=self.rough)
            found = found.with_states(
                _among(lost, again.settled), ElementForces(*(p[again.settled] for p in again))
            )
            self._tried[_among(moving, lost)] += 1
        at = found.settled[:, None]
        motion = np.where(at, found.motion, near.motion)
        if near.slopes is None:
            slopes = found.slopes
        else:
            slopes = np.where(at[..., None], found.slopes, near.slopes)
        self._near = near._replace(motion=motion, slopes=slopes)
        return found

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

    def whitened(self, parts: np.ndarray, roots: np.ndarray | None) -> np.ndarray:
        """Rows (state, order, sensor, column) in units of noise; without roots all independent."""
        rows = parts.reshape(*self.records.seen.shape, -1)
        if roots is None:
            flat = np.where(self.records.there, 1 / self.records.std(), 0.0)
            return _columns(rows * flat[..., None]).reshape(self.used.size, -1)
        rows = np.where(self.used[..., None], _columns(rows), 0.0)
        return np.linalg.solve(roots, rows).reshape(self.used.size, -1)

    def chi_square(self, values: np.ndarray, roots: np.ndarray | None) -> float:
        """What a law leaves, in units of noise."""
        square = self.whitened(self.left(values), roots) ** 2
        return float(np.sum(square if roots is None else _robust(square)))

    def scaled_start(self, values: np.ndarray) -> np.ndarray:
        """A start with the strength that brings its force nearest to what each state asks for."""
        asked = -np.sum(self.free.weights * (self.records.seen - self.place.driven), axis=2)
        given = force_along(self.effect, values, self.first)[:, list(self.records.orders)]
        size = np.sum(np.abs(given) ** 2)
        fraction = np.sum((asked * given.conj()).real) / size if size > 0 else 1.0
        return np.append(values[0] * (fraction if fraction > 0 else 1.0), values[1:])


def law_fit(
    kind: str,
    records: SensorRecords,
    place: SourcePattern,
    free: SourceFit,
    *,
    rough: bool = False,
    before: PlacedLaw | None = None,
) -> PlacedLaw:
    """The parameters with which a law along a row explains the sensors best.

    The fundamental along the row is what sensors and linear structure make of it; the law's force
    along the motion that the element has with it must move the sensors as they did. A `rough` fit
    takes the errors of all numbers as independent and ends early. Others go on until parameters
    and covariances belong to each other, from the start that looks best; with the fit `before`,
    which that gave, from the next ones, until one fits.
    """
    law = LawAtPlace(kind, records, place, free, rough)
    lower, upper = np.array(law.start.lower), np.array(law.start.upper)
    starts = [np.clip(law.scaled_start(np.array(at)), lower, upper) for at in law.start.starts]
    if rough:
        flat = min(starts, key=lambda at: law.chi_square(at, None))
        return _fitted(law, flat, None, 1)
    if before is not None and len(starts) == 1:
        return before
    # By errors of the motion too: without them a start near a contact that barely closes looks bad.
    each = []
    for at in starts:
        law.begin_anew()
        roots = law.roots(at)
        each.append((law.chi_square(at, roots), at, roots))
    tried, some = ([], slice(0, 1)) if before is None else ([before], slice(1, _STARTS))
    for _, at, roots in sorted(each, key=lambda one: one[0])[some]:
        law.begin_anew()
        tried.append(_fitted(law, at, roots, _ROUNDS))
        if tried[-1].determined and tried[-1].fits:
            break
    return min(tried, key=lambda fit: fit.chi_square)


def _fitted(
    law: LawAtPlace, values: np.ndarray, roots: np.ndarray | None, rounds: int
) -> PlacedLaw:
    """The law from a start and the errors there; further rounds take those of the last one."""
    start, trials = law.start, _ALL_TRIALS
    lower, upper, unit = map(np.array, (start.lower, start.upper, start.unit))
    still, spread = False, np.full(len(values), np.nan)
    for turn in range(rounds):
        roots = law.roots(values) if turn else roots
        size = np.where(np.abs(values) > 0, np.abs(values), unit)
        found = least_squares(
            lambda scaled, roots=roots, size=size: law.whitened(law.left(scaled * size), roots)[
                :, 0
            ],
            values / size,
            lambda scaled, roots=roots, size=size: (
                law.whitened(law.slopes(scaled * size), roots) * size
            ),
            bounds=(lower / size, upper / size),
            max_nfev=_ROUGH if rounds == 1 else min(_TRIALS, trials),
            xtol=1e-6,
            # Of a state whose motion is found on another branch no more than that counts.
            loss="linear" if rounds == 1 else "cauchy",
            f_scale=_OUTLYING,
        )
        trials -= found.nfev
        before, values = values, found.x * size
        spread = _spread(found.jac) * size
        still = bool(np.all(np.abs(values - before) <= _STILL * spread))
        if (turn > 0 and still and found.status > 0) or trials <= 0:
            break
    done = still and found.status > 0 and bool(np.all(law.forces(values).settled))
    names = EFFECTS[start.kind].parameters()
    return PlacedLaw(
        start.kind,
        2 * float(found.cost) / (1.0 if rounds == 1 else _OF_NOISE),
        int(law.used.sum()) - len(names),
        dict(zip(names, values.tolist(), strict=True)),
        dict(zip(names, np.where(done, spread, np.nan).tolist(), strict=True)),
    )


def _robust(square: np.ndarray) -> np.ndarray:
    """ρ of squares in units of noise, about one on average of noise."""
    scale = _OUTLYING**2
    return np.asarray(scale * np.log1p(square / scale) / _OF_NOISE)


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


class _ToldMotion(NamedTuple):
    """What sensors and linear structure make of each state, at the orders of the records."""

    force: Complex[np.ndarray, "state order"]  # along the row, that explains the state best
    motion: Complex[np.ndarray, "state order"]  # along the row, with it
    there: Bool[np.ndarray, "state order"]  # where this motion can be told from none


def _told_motion(records: SensorRecords, place: SourcePattern, free: SourceFit) -> _ToldMotion:
    force = np.sum(free.weights * (records.seen - place.driven), axis=2)
    own = place.own[:, list(records.orders)]
    motion = own * force
    motion[:, 0] += place.own_driven
    error = np.linalg.norm(free.weights * records.std(), axis=2) * np.abs(own)
    return _ToldMotion(force, motion, np.abs(motion) > _TOLD * error)


def _among(
    outer: Bool[np.ndarray, " state"], inner: Bool[np.ndarray, " some"]
) -> Bool[np.ndarray, " state"]:
    """Which states are among the inner ones, which are counted among the outer ones."""
    found = outer.copy()
    found[outer] = inner
    return found


def _scales(records: SensorRecords, place: SourcePattern, free: SourceFit) -> MotionScales:
    """Typical sizes along the row; as stiffness what the forces there are over the motion."""
    told = _told_motion(records, place, free)
    force, amplitude = np.abs(told.force[:, 0]), np.abs(told.motion[:, 0])
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
