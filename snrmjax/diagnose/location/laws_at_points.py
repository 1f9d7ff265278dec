"""Fits of force laws at an attachment point to the sensors' records."""

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
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, make_effect
from snrmjax.model.library.friction import CoulombFriction

_FIRST_OF_SQUARE = 4 / np.pi  # fundamental of a square wave of height 1
_SMALL = 1e-3  # of 1σ, step of finite differences by the records' errors
_ROUNDING = 1e-9
_ROUNDS = 6  # most reweighted fits, the first with independent errors
_TOLERANCE = 0.05  # of 1σ, tolerated change of parameters between fits
_RETRIES = 3  # from the sensors' estimate, for a state without convergence
_SIGNIFICANT = 3.0  # 1σ, below which a motion is not significant
_ROUGH = 8  # evaluations of a rough fit
_TRIALS = 40  # evaluations of any other fit
_ALL_TRIALS = 60  # evaluations from one start
_STARTS = 3  # starts of a law that does not fit from the first
_OUTLYING = 3.0  # 1σ, scale of the Cauchy loss ρ(r) = 9 log(1 + r²/9)
_OF_NOISE = 0.8741  # mean of ρ for normal r
_NOISE_RATIO = 1.2  # ratio of misfit to noise up to which a law fits


def stuck_forces(
    limit: float, required: Complex[np.ndarray, " state"], element: SurroundedElement
) -> ElementForces:
    """The forces of stuck friction: the required ones, up to the fundamental of full sliding.

    It has any reaction up to the friction limit: evaluated along a motion below its measurement
    error, its law would give the full force in the direction of that error.

    Arguments: `limit`: friction limit in N; `required`: fundamental of the force that the sensors
    require in each state. The motion is unchanged, and the force has no other harmonics.
    """
    capacity, magnitude = _FIRST_OF_SQUARE * limit, np.abs(required)
    sliding = magnitude > capacity
    direction = required / np.where(magnitude > 0, magnitude, 1.0)
    n_states, n_orders = element.motion.shape
    force = np.zeros((n_states, n_orders), dtype=complex)
    force[:, 1] = np.where(sliding, capacity * direction, required)
    by_parameter = np.zeros((n_states, n_orders, 1), dtype=complex)
    by_parameter[:, 1, 0] = np.where(sliding, _FIRST_OF_SQUARE * direction, 0.0)
    return ElementForces(
        force,
        element.motion,
        by_parameter,
        by_motion=np.zeros((n_states, n_orders, 2), dtype=complex),
        slopes=np.zeros((n_states, 2 * n_orders - 1, 2 * n_orders - 3)),
        settled=np.ones(n_states, dtype=bool),
    )


class LocatedLaw(NamedTuple):
    """A fitted law at a point; `std` is NaN where not converged or not all determined."""

    kind: str
    chi_square: float
    freedom: int
    parameters: dict[str, float]
    std: dict[str, float]

    @property
    def fits(self) -> bool:
        """Whether the residual is noise."""
        return self.chi_square < _NOISE_RATIO**2 * self.freedom

    @property
    def determined(self) -> bool:
        """Whether the fit converged, with a motion for every state, and all parameters have 1σ."""
        return bool(np.all(np.isfinite(list(self.std.values()))))


class LawAtPoint:
    """A kind of law along an influence vector, and its residual in the sensors' records.

    The fundamental of the motion along the vector is estimated from sensors and linear structure;
    the other harmonics are solved for, each trial starting from the last one. Force jumps are
    resolved unless `rough`. Dry friction sticks in states without significant motion.
    """

    def __init__(
        self,
        kind: str,
        records: SensorRecords,
        response: SourcePattern,
        free: SourceFit,
        rough: bool,
    ):
        self.records, self.response, self.free = records, response, free
        self.rough = rough
        self.scales = _scales(records, response, free)
        self.start = candidate(kind, self.scales)
        names = tuple(EFFECTS[kind].parameters())
        self.effect: Any = make_effect(kind, dict(zip(names, self.start.starts[0], strict=True)))
        friction = kind == CoulombFriction.kind
        jumps = friction and not rough
        own = response.own[:, : 1 + max(JUMP_ORDERS if jumps else OWN_ORDERS, *records.orders)]
        motion = np.zeros_like(own)
        estimated = _estimated_motion(records, response, free)
        motion[:, list(records.orders)] = np.where(estimated.there, estimated.motion, 0.0)
        motion[:, 1] = estimated.motion[:, 0]
        self.first = SurroundedElement(records.frequency, own, motion)
        self._required = -estimated.force[:, 0]
        self._stuck = ~estimated.there[:, 0] & friction
        self.begin_anew()

    def begin_anew(self) -> None:
        """Restart the element's motions from the sensors' estimate."""
        self._near: SurroundedElement | None = None
        self._tried = np.zeros(len(self.records.seen), dtype=int)
        self._last: tuple[np.ndarray, ElementForces | None] = (np.zeros(0), None)

    def forces(self, values: np.ndarray, *, exact: bool = False) -> ElementForces:
        """The law's forces at the element's motion; `exact` slopes are for covariances."""
        known, solved = self._last
        if solved is not None and np.array_equal(known, values) and not exact:
            return solved
        moving = ~self._stuck
        if moving.all():
            solved = self._moving_forces(values, moving, exact)
        else:
            solved = stuck_forces(float(values[0]), self._required, self.first)
            if moving.any():
                solved = solved.with_states(moving, self._moving_forces(values, moving, exact))
        self._last = values.copy(), solved
        return solved

    def _moving_forces(
        self, values: np.ndarray, moving: Bool[np.ndarray, " state"], exact: bool
    ) -> ElementForces:
        """Forces in moving states, each solved from its last motion."""
        first = self.first.of(moving)
        near = first if self._near is None else self._near
        solved = element_forces(self.effect, values, near, rough=self.rough, exact=exact)
        # Retry from the sensors' estimate in place of the last trial's motion, a few times.
        tried = self._tried[moving]
        lost = ~solved.settled & (tried < _RETRIES)
        if self._near is not None and lost.any():
            again = element_forces(self.effect, values, first.of(lost), rough=self.rough)
            solved = solved.with_states(
                _among(lost, again.settled), ElementForces(*(p[again.settled] for p in again))
            )
            self._tried[_among(moving, lost)] += 1
        at = solved.settled[:, None]
        motion = np.where(at, solved.motion, near.motion)
        if near.slopes is None:
            slopes = solved.slopes
        else:
            slopes = np.where(at[..., None], solved.slopes, near.slopes)
        self._near = near._replace(motion=motion, slopes=slopes)
        return solved

    def left(self, values: np.ndarray) -> Complex[np.ndarray, "state order sensor"]:
        """Residual: the records less the linear response to the measured force and the law's."""
        force = self.forces(values).force[:, list(self.records.orders)]
        return self.records.seen - self.response.driven + self.response.pattern * force[..., None]

    def slopes(self, values: np.ndarray) -> Complex[np.ndarray, "state order sensor parameter"]:
        """Derivatives of the residual by the parameters."""
        by = self.forces(values).by_parameter[:, list(self.records.orders)]
        return self.response.pattern[..., None] * by[:, :, None]

    def roots(self, values: np.ndarray) -> Float[np.ndarray, "state entry entry"]:
        """Cholesky factors of the residual's covariances, from the errors of the records.

        These act directly, and on the law's force through the fundamental motion along the vector.
        """
        records, response, count = self.records, self.response, len(self.records.seen)
        by_motion = self.forces(values, exact=True).by_motion[:, list(records.orders)]
        slopes = []
        for unit in np.eye(records.n_inputs):
            perturbed = records.perturbed(np.tile(_SMALL * unit, (count, 1))) - records.seen
            motion = response.own[:, 1] * np.sum(self.free.weights * perturbed, axis=2)[:, 0]
            parts = np.stack([motion.real, -motion.imag], axis=1)
            force = np.einsum("sp,sop->so", parts, by_motion)
            slopes.append(_parts(perturbed + response.pattern * force[..., None]) / _SMALL)
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
        """Mask of the measured real numbers of each state."""
        return np.repeat(self.records.there.reshape(len(self.records.seen), -1), 2, axis=1)

    def whitened(self, parts: np.ndarray, roots: np.ndarray | None) -> np.ndarray:
        """Rows (state, order, sensor, column) in units of noise; independent without roots."""
        rows = parts.reshape(*self.records.seen.shape, -1)
        if roots is None:
            flat = np.where(self.records.there, 1 / self.records.std(), 0.0)
            return _columns(rows * flat[..., None]).reshape(self.used.size, -1)
        rows = np.where(self.used[..., None], _columns(rows), 0.0)
        return np.linalg.solve(roots, rows).reshape(self.used.size, -1)

    def chi_square(self, values: np.ndarray, roots: np.ndarray | None) -> float:
        """χ² of the residual, robust with roots."""
        square = self.whitened(self.left(values), roots) ** 2
        return float(np.sum(square if roots is None else _robust(square)))

    def scaled_start(self, values: np.ndarray) -> np.ndarray:
        """A start scaled to the strength whose force is closest to that required by the states."""
        required = -np.sum(self.free.weights * (self.records.seen - self.response.driven), axis=2)
        law_force = force_along(self.effect, values, self.first)[:, list(self.records.orders)]
        norm = np.sum(np.abs(law_force) ** 2)
        fraction = np.sum((required * law_force.conj()).real) / norm if norm > 0 else 1.0
        return np.append(values[0] * (fraction if fraction > 0 else 1.0), values[1:])


def law_fit(
    kind: str,
    records: SensorRecords,
    response: SourcePattern,
    free: SourceFit,
    *,
    rough: bool = False,
    before: LocatedLaw | None = None,
) -> LocatedLaw:
    """The best-fit parameters of a law along an influence vector.

    The fundamental motion along the vector is estimated from sensors and linear structure; the
    law's force at the element's motion must reproduce the sensors' records. A `rough` fit takes all
    errors as independent and ends early. Others iterate until parameters and covariances agree,
    from the best start; given the fit `before` from that start, from the next ones until one fits.
    """
    law = LawAtPoint(kind, records, response, free, rough)
    lower, upper = np.array(law.start.lower), np.array(law.start.upper)
    starts = [np.clip(law.scaled_start(np.array(at)), lower, upper) for at in law.start.starts]
    if rough:
        flat = min(starts, key=lambda at: law.chi_square(at, None))
        return _fitted(law, flat, None, 1)
    if before is not None and len(starts) == 1:
        return before
    # Include errors of the motion: else a start with a barely closing contact has a large χ².
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
    law: LawAtPoint, values: np.ndarray, roots: np.ndarray | None, rounds: int
) -> LocatedLaw:
    """The law fitted from a start, with covariances updated after each round."""
    start, trials = law.start, _ALL_TRIALS
    lower, upper, unit = map(np.array, (start.lower, start.upper, start.unit))
    unchanged, spread = False, np.full(len(values), np.nan)
    for iteration in range(rounds):
        roots = law.roots(values) if iteration else roots
        scale = np.where(np.abs(values) > 0, np.abs(values), unit)
        solution = least_squares(
            lambda scaled, roots=roots, scale=scale: law.whitened(law.left(scaled * scale), roots)[
                :, 0
            ],
            values / scale,
            lambda scaled, roots=roots, scale=scale: (
                law.whitened(law.slopes(scaled * scale), roots) * scale
            ),
            bounds=(lower / scale, upper / scale),
            max_nfev=_ROUGH if rounds == 1 else min(_TRIALS, trials),
            xtol=1e-6,
            # Robust against states whose motion is solved on another branch.
            loss="linear" if rounds == 1 else "cauchy",
            f_scale=_OUTLYING,
        )
        trials -= solution.nfev
        before, values = values, solution.x * scale
        spread = _spread(solution.jac) * scale
        unchanged = bool(np.all(np.abs(values - before) <= _TOLERANCE * spread))
        if (iteration > 0 and unchanged and solution.status > 0) or trials <= 0:
            break
    done = unchanged and solution.status > 0 and bool(np.all(law.forces(values).settled))
    names = EFFECTS[start.kind].parameters()
    return LocatedLaw(
        start.kind,
        2 * float(solution.cost) / (1.0 if rounds == 1 else _OF_NOISE),
        int(law.used.sum()) - len(names),
        dict(zip(names, values.tolist(), strict=True)),
        dict(zip(names, np.where(done, spread, np.nan).tolist(), strict=True)),
    )


def _robust(square: np.ndarray) -> np.ndarray:
    """ρ of squares in units of noise, with mean one for normal noise."""
    scale = _OUTLYING**2
    return np.asarray(scale * np.log1p(square / scale) / _OF_NOISE)


def _spread(slopes: Float[np.ndarray, "row parameter"]) -> Float[np.ndarray, " parameter"]:
    """1σ of every parameter; NaN where the rows do not determine them all."""
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


class _EstimatedMotion(NamedTuple):
    """Force and motion estimated from sensors and linear structure, at the recorded orders."""

    force: Complex[np.ndarray, "state order"]  # least-squares force along the influence vector
    motion: Complex[np.ndarray, "state order"]  # along the influence vector, with that force
    there: Bool[np.ndarray, "state order"]  # where this motion is significant


def _estimated_motion(
    records: SensorRecords, response: SourcePattern, free: SourceFit
) -> _EstimatedMotion:
    force = np.sum(free.weights * (records.seen - response.driven), axis=2)
    own = response.own[:, list(records.orders)]
    motion = own * force
    motion[:, 0] += response.own_driven
    error = np.linalg.norm(free.weights * records.std(), axis=2) * np.abs(own)
    return _EstimatedMotion(force, motion, np.abs(motion) > _SIGNIFICANT * error)


def _among(
    outer: Bool[np.ndarray, " state"], inner: Bool[np.ndarray, " some"]
) -> Bool[np.ndarray, " state"]:
    """Mask over all states of the `inner` ones, which index the `outer` ones."""
    mask = outer.copy()
    mask[outer] = inner
    return mask


def _scales(records: SensorRecords, response: SourcePattern, free: SourceFit) -> MotionScales:
    """Typical magnitudes along the influence vector, with stiffness = force over motion."""
    estimated = _estimated_motion(records, response, free)
    force, amplitude = np.abs(estimated.force[:, 0]), np.abs(estimated.motion[:, 0])
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
