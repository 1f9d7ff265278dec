"""The force balance of one nonlinear mode, fitted to states as they are read or corrected.

Near resonance a mode with stiffness K(a) and damping D(a) that depend on the displacement amplitude
a moves by iΩAF/V = κ(K(a) − Ω² + iΩD(a)); A is the modal constant of the model and κ the modal mass
that the data ask for over the model's. With K and D as sums of known functions this is linear in
all unknowns, and the likelihood says how well a reading of the data agrees with a single mode.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

UNSTATED = 0.01
"""1σ, relative and in rad, of which an unstated error is a multiple."""

_PASSES = 3  # of the weights, which depend on the slopes of the curves
_LEAST_SCALE = 0.05  # of `UNSTATED`, that an estimated error may be
_COLLINEAR = 1e-13  # of the normal equations' largest eigenvalue
_STEEP = 30.0  # a curve's own share in the error of a state, at most


class ModeStates(NamedTuple):
    """States as the sensor that moves most has them, ready for the balance of one mode."""

    row: Int[np.ndarray, " state"]  # in the table
    level: Int[np.ndarray, " state"]  # 0, 1, …
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N, or V
    velocity: Complex[np.ndarray, " state"]  # m/s, as recorded, of the sign of the mode
    beside: Complex[np.ndarray, " state"]  # m/s, of the other modes
    order: Float[np.ndarray, " state"]  # of the test, 0 to 1
    errors: Float[np.ndarray, "state 3"]  # 1σ of log force, log velocity and phase
    stated: bool  # whether these were stated; otherwise only their sizes to one another count
    constant: float  # A, 1/kg; 1 where there is no model
    level_stds: tuple[float, float, float, float]  # gain, phase, frequency, damping; relative

    @property
    def n_levels(self) -> int:
        """Number of levels."""
        return int(self.level.max()) + 1


class Corrected(NamedTuple):
    """States with something corrected, and what that does to errors and likelihood."""

    velocity: Complex[np.ndarray, " state"]
    force: Float[np.ndarray, " state"]
    stretch: Float[np.ndarray, " state"]  # of the 1σ of log velocity
    log_jacobian: float  # of the recorded to the corrected velocities
    parameters: int  # that were chosen for it
    extra: tuple[str, ...] = ()  # unknowns of the balance beside the curves, by name
    used: Bool[np.ndarray, " state"] | None = None  # states that are left out are False
    floor: float = 0.0  # N, 1σ that the force has at any size, in phase and across


class BalanceFit(NamedTuple):
    """The likeliest balance: κ, curves, further unknowns with their 1σ."""

    log_likelihood: float
    criterion: float  # −2 log likelihood and ln(numbers) for every unknown
    mass: float  # κ
    mass_std: float
    stiffness: Float[np.ndarray, " state"]  # K at the states, rad²/s²
    damping: Float[np.ndarray, " state"]  # D at the states, 1/s
    scale: float  # of the errors that were stated or assumed
    extra: Float[np.ndarray, " extra"]
    extra_std: Float[np.ndarray, " extra"]
    residuals: Float[np.ndarray, "state part"]  # whitened: along and across the phasor
    families: tuple[str, str]
    used: Bool[np.ndarray, " state"]
    predicted: Complex[np.ndarray, " state"]  # iΩAF/V

    relative: Complex[np.ndarray, " state"]  # distance of the phasors over their size

    @property
    def misfit(self) -> float:
        """Relative distance of the phasors, root mean square."""
        return float(np.sqrt(np.mean(np.abs(self.relative) ** 2)))


def as_recorded(states: ModeStates) -> Corrected:
    """Nothing corrected."""
    ones = np.ones(len(states.level))
    return Corrected(states.velocity - states.beside, states.force, ones, 0.0, 0)


STIFFNESS = ("1", "1,2", "1,1/2", "1,1", "1,1,2", "1,2,4", "1,2,4,6", "1,-1", "1,-1,1")
DAMPING = ("1", "1,1", "1,2", "1,-1", "1,-1,1", "1,1,2", "1,-1,1,2")
SPLINES = ("s4", "s5", "s7", "s9")
"""Families of curves: powers of the amplitude, or a natural cubic spline of its logarithm."""


class Basis(NamedTuple):
    """Functions of the amplitude whose sum is a curve, and their derivatives by its logarithm."""

    values: Float[np.ndarray, "state term"]
    slopes: Float[np.ndarray, "state term"]


def basis(family: str, amplitude: Float[np.ndarray, " state"]) -> Basis:
    """Powers of the amplitude over the largest, or natural cubic splines of its logarithm."""
    return _basis(family, amplitude.tobytes())


@functools.lru_cache(maxsize=128)
def _basis(family: str, amplitudes: bytes) -> Basis:
    """The basis of amplitudes as bytes: corrections of levels and trends share them."""
    amplitude = np.frombuffer(amplitudes)
    u = np.maximum(amplitude / amplitude.max(), 1e-6)
    if family[0] == "s":
        return _spline_basis(np.log(u), int(family[1:]))
    powers = np.array([0.0, *(_power(term) for term in family.split(",")[1:])])
    values = u[:, None] ** powers
    return Basis(values, powers * values)


def _power(term: str) -> float:
    top, _, bottom = term.partition("/")
    return float(top) / float(bottom or 1)


def _spline_basis(x: Float[np.ndarray, " state"], knots: int) -> Basis:
    """The natural cubic splines that are one at one knot; knots at quantiles."""
    from scipy.interpolate import CubicSpline  # keeps the package quick to import

    at = np.quantile(x, np.linspace(0, 1, knots))
    least = 1e-3 + 0.02 * np.ptp(x)
    kept = [at[0]]
    for one in at[1:]:
        if one - kept[-1] > least:
            kept.append(one)
    if len(kept) < 3:
        flat = np.ones_like(x)
        return Basis(np.stack([flat, x - x.mean()], axis=1), np.stack([0 * flat, flat], axis=1))
    places = np.array(kept)
    curves = CubicSpline(places, np.eye(len(places)), bc_type="natural")
    return Basis(curves(x), curves(x, 1))


def fit_balance(
    states: ModeStates,
    corrected: Corrected,
    families: tuple[str, str],
    *,
    mass: float | None = None,
) -> BalanceFit:
    """The likeliest balance with curves of two families, of stiffness and of damping.

    Each state's equation is divided by its own iΩAF/V, so that errors of amplitude and force lie
    along the real axis and those of the phase across. An error of the velocity also moves the
    amplitude at which the curves are read, which steep curves make large. What levels share is
    unknown too, within the 1σ of `level_stds`.

    Arguments: `mass` holds κ. Unknowns of `Corrected.extra`: `frequency_trend` and `gain_trend`
    (relative, from first to last state), `gain:k`, `frequency:k` and `damping:k` of level k.
    """
    used = corrected.used if corrected.used is not None else np.ones(len(states.level), dtype=bool)
    at = np.flatnonzero(used)
    omega, level = states.frequency[at], states.level[at]
    velocity, force = corrected.velocity[at], corrected.force[at]
    sigma = np.where(states.errors[at] > 0, states.errors[at], 1e-4)
    sigma = sigma * np.column_stack([np.ones(len(at)), corrected.stretch[at], np.ones(len(at))])
    sigma = np.hypot(sigma, np.outer(corrected.floor / np.abs(force), [1.0, 0.0, 1.0]))
    y = 1j * omega * states.constant * force / velocity
    amplitude = np.abs(velocity) / omega
    middle = float(np.mean(omega**2))
    of_k, of_d = basis(families[0], amplitude), basis(families[1], amplitude)
    inertia = (middle - omega**2).astype(complex)
    root_middle = np.sqrt(middle)
    curves = np.column_stack(
        [of_k.values * middle, 1j * omega[:, None] * of_d.values * root_middle]
    )
    n_k = of_k.values.shape[1]
    sensitivity = np.ones(len(at), dtype=complex)  # of a residual to the logarithm of |V|
    kappa, k_now = 1.0, np.zeros(len(at))
    d_now = np.zeros(len(at))
    order = states.order[at] - 0.5
    fitted: _Solution
    for _ in range(_PASSES):
        columns = np.column_stack([inertia, curves]) / y[:, None]
        changes = {
            "gain": sensitivity,
            "phase": np.full(len(at), 1j),
            "frequency": 2 * kappa * (middle + k_now) / y,
            "damping": 1j * omega * kappa * d_now / y,
            "force": np.ones(len(at), dtype=complex),
        }
        more, prior = _of_levels(states, level, changes)
        extra = [_of_extra(name, level, order, changes) for name in corrected.extra]
        design = np.column_stack([columns, *extra, more])
        target = np.ones(len(at), dtype=complex)
        if mass is not None:
            target = target - mass * design[:, 0]
            design = design[:, 1:]
        root, log_det = _whitening(sensitivity, sigma)
        fitted = _solve(design, target, root, prior, states.stated)
        theta = fitted.theta if mass is None else np.concatenate([[mass], fitted.theta])
        kappa = theta[0]
        safe = kappa if abs(kappa) > 1e-12 else 1e-12
        own = theta[1 : 1 + n_k], theta[1 + n_k : 1 + curves.shape[1]]
        k_now = of_k.values @ own[0] * middle / safe
        d_now = of_d.values @ own[1] * root_middle / safe
        steep = of_k.slopes @ own[0] * middle + 1j * omega * (of_d.slopes @ own[1]) * root_middle
        steep = steep / y
        sensitivity = 1 + steep * np.minimum(1.0, _STEEP / np.maximum(np.abs(steep), 1e-300))
    n = 2 * len(at)
    log_likelihood = (
        -0.5 * (fitted.square / fitted.scale**2 + 2 * n * np.log(fitted.scale) + log_det)
        + corrected.log_jacobian
    )
    lost = 2 * (len(states.level) - len(at))
    unknowns = curves.shape[1] + (mass is None) + len(corrected.extra) + corrected.parameters + lost
    std = fitted.std if mass is None else np.concatenate([[0.0], fitted.std])
    first = 1 + curves.shape[1]
    m = len(corrected.extra)
    whole = np.zeros(len(states.level))
    stiffness, damping = whole.copy(), whole.copy()
    stiffness[at], damping[at] = middle + k_now, d_now
    residuals = np.zeros((len(states.level), 2))
    residuals[at] = fitted.residuals / fitted.scale
    relative = np.zeros(len(states.level), dtype=complex)
    relative[at] = fitted.relative
    predicted = np.full(len(states.level), np.nan + 0j)
    predicted[at] = y * (1 + fitted.relative)
    return BalanceFit(
        log_likelihood,
        -2 * log_likelihood + unknowns * np.log(n),
        *(float(theta[0]), float(std[0]), stiffness, damping, fitted.scale),
        *(theta[first : first + m], std[first : first + m], residuals, families, used),
        predicted,
        relative,
    )


class _Solution(NamedTuple):
    theta: np.ndarray
    std: np.ndarray
    square: float
    scale: float
    residuals: np.ndarray
    relative: np.ndarray


def _of_levels(
    states: ModeStates, level: np.ndarray, changes: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Columns of what levels share (gain, phase, frequency, damping) and the 1σ of each."""
    there = np.unique(level)
    member = (level[:, None] == there).astype(float)
    # What all levels share is in the curves and in κ already: differences alone, orthonormal ones.
    contrasts = _contrasts(len(there))
    columns = [np.zeros((len(level), 0), dtype=complex)]
    prior: list[float] = []
    for kind, std in zip(("gain", "phase", "frequency", "damping"), states.level_stds, strict=True):
        if std > 0 and len(there) > 1:
            columns.append(member @ contrasts * changes[kind][:, None])
            prior += [std] * (len(there) - 1)
    return np.concatenate(columns, axis=1), np.array(prior)


@functools.lru_cache
def _contrasts(n: int) -> np.ndarray:
    """Orthonormal columns whose sums are zero."""
    return np.linalg.svd(np.eye(n) - 1 / n)[0][:, : n - 1]


def _of_extra(
    name: str, level: np.ndarray, order: np.ndarray, changes: dict[str, np.ndarray]
) -> np.ndarray:
    """The column of an unknown: `kind_trend`, along the test, or `kind:1+3`, of some levels."""
    kind, _, which = name.partition(":")
    rows = np.isin(level, [int(k) for k in which.split("+")]) if which else order
    return rows * changes[kind.removesuffix("_trend")]


def _whitening(
    sensitivity: np.ndarray, sigma: np.ndarray
) -> tuple[Float[np.ndarray, "state 2 2"], float]:
    """Inverse Cholesky factors of every state's covariance, and the sum of log determinants."""
    sf, sv, sp = sigma.T
    re, im = sensitivity.real, sensitivity.imag
    a = sf**2 + (sv * re) ** 2
    b = sv**2 * re * im
    c = sp**2 + (sv * im) ** 2
    det = a * c - b**2
    root_a = np.sqrt(a)
    low = np.sqrt(det / a)
    root = np.zeros((len(a), 2, 2))
    root[:, 0, 0] = 1 / root_a
    root[:, 1, 0] = -b / (a * low)
    root[:, 1, 1] = 1 / low
    return root, float(np.sum(np.log(det)))


def _solve(
    design: np.ndarray, target: np.ndarray, root: np.ndarray, prior: np.ndarray, stated: bool
) -> _Solution:
    """Least squares of complex equations; the last unknowns have the prior 1σ."""
    parts = np.stack([design.real, design.imag], axis=1)
    wanted = np.stack([target.real, target.imag], axis=1)
    white = np.einsum("nij,njk->nik", root, parts).reshape(-1, design.shape[1])
    goal = np.einsum("nij,nj->ni", root, wanted).reshape(-1)
    m, n = design.shape[1], len(goal)
    size = np.linalg.norm(white, axis=0)
    size = np.where(size > 0, size, 1.0)
    unit = white / size
    gram, onto = unit.T @ unit, unit.T @ goal
    held = np.zeros(m)
    scale = 1.0
    for _ in range(2 if len(prior) else 1):
        if len(prior):  # in units of the errors' scale, which divides the equations
            held[m - len(prior) :] = scale / prior / size[m - len(prior) :]
        values, directions = np.linalg.eigh(gram + np.diag(held**2))
        kept = values > _COLLINEAR * values[-1]
        inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
        solved = directions @ (inverse * (directions.T @ onto))
        residual = unit @ solved - goal
        square = float(residual @ residual + np.sum((held * solved) ** 2))
        found = np.sqrt(square / max(n - (m - len(prior)), 1))
        scale = max(1.0, found) if stated else max(_LEAST_SCALE, found)
    theta = solved / size
    std = scale * np.sqrt(directions**2 @ inverse) / size
    relative = design @ theta - target
    return _Solution(theta, std, square, float(scale), residual.reshape(-1, 2), relative)


def best_balance(
    states: ModeStates,
    corrected: Corrected,
    *,
    start: tuple[str, str] = ("1,2", "1"),
    mass: float | None = None,
) -> BalanceFit:
    """The balance with the families of the smallest criterion, found by turns of both curves."""
    n = len(states.level)
    splines = [one for one in SPLINES if 4 * int(one[1:]) <= n]
    best = fit_balance(states, corrected, start, mass=mass)
    for _ in range(2):
        before = best.families
        for which, families in ((0, STIFFNESS), (1, DAMPING)):
            for family in (*families, *splines):
                pair = (family, best.families[1]) if which == 0 else (best.families[0], family)
                if pair == best.families:
                    continue
                one = fit_balance(states, corrected, pair, mass=mass)
                if one.criterion < best.criterion:
                    best = one
        if best.families == before:
            break
    return best
