"""Structures from their mass, damping and stiffness matrices."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from snrmjax.model.attachment import InfluenceVector, influence_vector
from snrmjax.model.builders.free_coordinates import coupled_first
from snrmjax.model.builders.modal_damping import modal_damping
from snrmjax.model.effect_base import AbstractEffect, AbstractForce, checked_effects
from snrmjax.model.modes import LinearModesStd, OptionalModalData, RigidBodyModes, linear_modes
from snrmjax.model.moving_base import BaseMotion
from snrmjax.model.structures import Structure, structure
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import POSITIVE, InputError, require

_SYMMETRIC = 1e-8  # of the largest entry: permitted asymmetry, as of finite-element output
_RIGID = 1e-9  # of the largest of a few ω²: smaller ones belong to rigid-body modes
_ROUNDING = 2e-14  # of the largest entry, per unknown: rounding error of a zero
_SMALL = 100  # unknowns, above which a few modes are computed by Lanczos' method
_MORE, _PASSES = 6, 4  # modes in addition to those wanted; number of shifts
_DEPENDENT = 1e-10  # of its norm: remainder below which a vector is linearly dependent
_DENSE = 2000  # unknowns, above which only the wanted modes are computed

Phasor = float | complex


class Matrices(NamedTuple):
    """M ẍ + C ẋ + K x = f, the first arguments of `from_matrices`."""

    mass: Any  # kg
    damping: Any  # N s/m
    stiffness: Any  # N/m
    points: tuple[str, ...]  # one name for each unknown


def from_matrices(
    mass: Any,
    damping: Any,
    stiffness: Any,
    points: Sequence[str] | None = None,
    *,
    force: str | Mapping[str, Phasor] | None = None,
    base: BaseMotion | None = None,
    unbalance: float | None = None,
    effects: AbstractEffect | Iterable[AbstractEffect] = (),
    n_modes: int | None = None,
    residuals: bool = True,
    mode_of_interest: int = 0,
    sensors: Sequence[str] | None = None,
    name: str = "structure",
) -> Structure:
    """A structure from matrices, in modal coordinates: M ẍ + C ẋ + K x + Σ effects = b F cos Ωt.

    Arguments: `mass` (kg), `damping` (N s/m) and `stiffness` (N/m) of shape (unknown, unknown),
    dense or SciPy sparse; `damping` may also be one damping ratio for every mode, or None.
    `points` names the unknowns ("x1", "x2", … by default). `force` is where the recorded force
    acts: a point, or newtons per newton at points, complex for a phase lead.
    `base` instead is base excitation: its acceleration a acts as the force −M r a, with r the
    rigid-body displacement of each unknown per unit base displacement (`base_motion`'s `along`);
    all motion, that of the effects too, is relative to the base.
    `unbalance` (kg m) of a rotor: the force is then U Ω², at the points of `force`.
    `effects` act at points by their `at`, in N and m, in addition to the matrices.
    `n_modes` keeps that many modes of lowest frequency and, with `residuals`, one residual vector
    for every attachment of an effect and for the force: the exact static flexibility of the
    truncated modes, as additional modes of high frequency.
    `sensors` are the measured points, by default all.
    Damping that couples modes is kept. Modes without stiffness become rigid-body modes; those
    that an effect acts on become modes of zero frequency, after the others: masses without a
    linear spring, such as that of a nonlinear energy sink.

    Returns a `Structure`. The truncation error of `n_modes` is about (Ω/ω)² of the static part of
    the higher modes, with ω the first truncated natural frequency, for each harmonic Ω.
    Raises `ValueError` for matrices that are not square, finite and symmetric, or of different
    sizes, a mass that is not positive definite, a negative stiffness, unknown or repeated points,
    a force or base that excites no mode, and both or neither of them.
    Reference: MacNeal, Comput. Struct. 1 (1971) 581, doi:10.1016/0045-7949(71)90031-9.

    >>> from snrmjax.model.effects import make_effect
    >>> spring = make_effect("cubic_stiffness", {"coefficient": 0.5}, at="x1")
    >>> two = from_matrices(*chain([1.0, 1.0], [1.0, 1.0, 1.0]), force="x1", effects=spring)
    >>> two.modes.natural_frequency.round(3)
    Array([1.   , 1.732], dtype=float64)
    """
    m, k = _checked("mass", mass), _checked("stiffness", stiffness)
    size = m.shape[0]
    if k.shape != m.shape:
        raise InputError(f"`mass` has shape {m.shape}, but `stiffness` has {k.shape}.")
    names = tuple(points) if points is not None else tuple(f"x{i + 1}" for i in range(size))
    check_names(names, size)
    made = checked_effects(effects)
    forces = [effect for effect in made if isinstance(effect, AbstractForce)]
    attachments = dict.fromkeys(b for e in forces for b in e.influence_vectors if b is not None)
    influence = [_column(names, b, "an effect") for b in attachments]
    load = _load(m, names, force, base)
    squared, shapes, rigid = _modes(m, k, n_modes)
    if n_modes is not None and residuals:
        loads = [*influence, load.real, *([load.imag] if np.any(load.imag) else [])]
        squared, shapes = _with_residuals(k, m, squared, shapes, rigid, loads)
    n_flexible = len(squared)
    if rigid.shape[1] and influence:
        # Motions constrained only by elements become modes of zero frequency, as of an energy sink.
        rotation, n_free = coupled_first(np.stack(influence) @ rigid, np.abs(rigid).max(axis=0))
        free, rigid = np.split(rigid @ rotation, [n_free], axis=1)
        squared, shapes = np.pad(squared, (0, n_free)), np.concatenate([shapes, free], axis=1)
    if not n_flexible:
        raise InputError(
            "`stiffness` is zero for every motion: the mode of interest needs a linear stiffness."
        )
    if not np.any(load @ shapes):
        raise InputError(
            "the force excites no mode of the structure."
            if base is None
            else "the base excites no mode of the structure."
        )
    omega = np.sqrt(squared)
    if damping is None or (np.ndim(damping) == 0 and not scipy.sparse.issparse(damping)):
        ratio = np.where(omega > 0, 0.0 if damping is None else float(damping), 0.0)
        coupling, ratio_std = None, np.zeros(omega.shape)
    else:
        c = _checked("damping", damping)
        if c.shape != m.shape:
            raise InputError(f"`damping` has shape {c.shape}, but there are {size} unknowns.")
        ratio, coupling, ratio_std = modal_damping(c, m, k, shapes, omega)
    measured = tuple(sensors) if sensors is not None else names
    with_sensor = np.array(_indices(names, measured, "`sensors`"))
    without_sensor = np.setdiff1d(np.arange(size), with_sensor).tolist()
    other = {names[i]: shapes[i] for i in without_sensor}
    participation = load @ shapes
    modes = linear_modes(
        omega,
        ratio,
        shapes[with_sensor],
        participation.real,
        sensors=measured,
        mode_of_interest=mode_of_interest,
        rigid_body=RigidBodyModes(rigid[with_sensor], (load @ rigid).real),
        std=LinearModesStd(damping_ratio=ratio_std),
        optional=OptionalModalData(
            other,
            coupling,
            -participation.imag if np.any(participation.imag) else None,
            base,
            unbalance,
        ),
    )
    return structure(modes, effects=made, name=name)


def _load(
    mass: Any,
    names: tuple[str, ...],
    force: str | Mapping[str, Phasor] | None,
    base: BaseMotion | None,
) -> np.ndarray:
    """Load vector: newtons at the unknowns per newton, or per m/s² of the base."""
    if (force is None) == (base is None):
        raise InputError("a structure has either a `force` or a moving `base`.")
    if base is None:
        return _column(names, force or {}, "`force`")
    _indices(names, [point for point, _ in base.along], "the base's `along`")
    return -(mass @ base.cosines(names))


def _checked(name: str, matrix: Any) -> Any:
    """A checked square symmetric matrix, dense up to `_DENSE` unknowns."""
    if matrix is None:
        raise InputError(f"`{name}` must be a matrix, but is missing.")
    sparse = scipy.sparse.issparse(matrix)
    values: Any = matrix.tocsc().astype(float) if sparse else np.asarray(matrix, dtype=np.float64)
    if values.ndim != 2 or values.shape[0] != values.shape[1] or not values.shape[0]:
        raise InputError(f"`{name}` must be a square matrix, but has shape {values.shape}.")
    require(f"`{name}`", values.data if sparse else values)
    asymmetry, largest = abs(values - values.T).max(), abs(values).max()
    if asymmetry > _SYMMETRIC * largest:
        raise InputError(f"`{name}` must be symmetric, but its two halves differ by {asymmetry:g}.")
    values = 0.5 * (values + values.T)
    return values.toarray() if sparse and values.shape[0] <= _DENSE else values


def check_names(names: Sequence[str], size: int) -> None:
    """Refuse names of points whose number differs from the unknowns, or repeated ones."""
    if len(names) != size:
        raise InputError(f"`points` names {len(names)} points, but there are {size} unknowns.")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InputError(f"`points` names {name!r} twice.")


def _indices(names: tuple[str, ...], points: Iterable[str], what: str) -> list[int]:
    """Indices of points among the unknowns."""
    index = {name: k for k, name in enumerate(names)}
    for point in points:
        if point not in index:
            near = suggestion(point, names) or f"; known are {', '.join(names[:12])}"
            raise InputError(f"{what} names the point {point!r}, which does not exist{near}.")
    return [index[point] for point in points]


def _column(
    names: tuple[str, ...], at: str | Mapping[str, Phasor] | InfluenceVector, what: str
) -> np.ndarray:
    """Influence vector over all unknowns; complex for a force with phases."""
    weights = dict(at.items() if isinstance(at, Mapping) else influence_vector(at))
    column = np.zeros(len(names), dtype=complex)
    column[_indices(names, weights, what)] = list(weights.values())
    return column if np.any(column.imag) else column.real


def _modes(m: Any, k: Any, n_modes: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ω² and mass-normalised shapes of flexible modes, and shapes of rigid-body modes."""
    size = m.shape[0]
    wanted = size if n_modes is None else n_modes
    if not 1 <= wanted <= size:
        raise InputError(f"`n_modes` must lie between 1 and {size}, but is {n_modes}.")
    if wanted + _MORE < size and (scipy.sparse.issparse(k) or size > _SMALL):
        squared, shapes = _lowest_modes(m, k, wanted + _MORE)
        rigid = _RIGID * squared.max()
    else:
        try:
            squared, shapes = scipy.linalg.eigh(_dense(k), _dense(m))
        except np.linalg.LinAlgError as error:
            raise InputError("`mass` must be positive definite, but is not.") from error
        rigid = max(_ROUNDING * size * squared.max(), np.finfo(float).tiny)
    order = np.argsort(squared)
    squared, shapes = squared[order], shapes[:, order]
    if squared[0] < -rigid:
        raise InputError(
            "`stiffness` must not be negative, but one of the squared natural frequencies is "
            f"{squared[0]:g} 1/s²: zero displacement is an unstable equilibrium. Write the model "
            "about a stable one, x = x₀ + y, where all spring forces balance: k x + c x³ with "
            "k < 0 rests at x₀ = √(−k/c), and has there the stiffness −2k, a quadratic spring "
            "3 c x₀ and the cubic spring c."
        )
    shapes = shapes * np.where(shapes[np.argmax(np.abs(shapes), 0), range(len(order))] < 0, -1, 1)
    is_rigid = squared <= rigid
    keep = np.flatnonzero(~is_rigid)[:wanted]
    return squared[keep], shapes[:, keep], shapes[:, is_rigid]


def _lowest_modes(m: Any, k: Any, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest modes by shift-invert Lanczos, rigid-body modes included.

    A shift of the order of the lowest ω² costs no digits; a far larger one, as estimated from the
    entries of a fine mesh, costs all. The shift is therefore reduced in several passes.
    """
    springs = abs(k.diagonal())
    entries = springs[springs > 0].min() / abs(m.diagonal()).max()
    shifts, inverse = [0.0], _Inverse(k)
    if not inverse.regular:
        shifts = [-1e-3 * entries]
    for _ in range(_PASSES):
        try:
            solve = inverse if not shifts[-1] else _Inverse(k - shifts[-1] * m)
            operator = scipy.sparse.linalg.LinearOperator(k.shape, solve.solve)
            squared, shapes = scipy.sparse.linalg.eigsh(
                k, wanted, m, sigma=shifts[-1], OPinv=operator
            )
        except RuntimeError as error:
            raise InputError(
                "the lowest modes are lost to rounding: the mesh is too fine for these matrices, "
                "or `stiffness` and `mass` have a common null space."
            ) from error
        flexible = squared[squared > _RIGID * squared.max()]
        if shifts[-1] == 0 or -shifts[-1] < 0.2 * flexible.min():
            break
        shifts.append(-0.1 * flexible.min())
    return squared, shapes


class _Inverse:
    """A factorised symmetric matrix, dense or sparse."""

    def __init__(self, matrix: Any) -> None:
        self.solve: Callable[[np.ndarray], np.ndarray] = lambda right: np.full_like(right, np.nan)
        if scipy.sparse.issparse(matrix):
            try:
                factors = scipy.sparse.linalg.splu(matrix)
            except RuntimeError:  # exactly singular
                self.regular = False
                return
            self.solve, pivots = factors.solve, factors.U.diagonal()
        else:
            upper, order, _ = scipy.linalg.lapack.dgetrf(matrix)
            self.solve = lambda right: scipy.linalg.lapack.dgetrs(upper, order, right)[0]
            pivots = np.diag(upper)
        magnitude = np.abs(pivots)
        # A rigid-body motion leaves a pivot of the order of rounding.
        self.regular = bool(magnitude.min() > _ROUNDING * magnitude.max())


def _dense(matrix: Any) -> np.ndarray:
    return matrix.toarray() if scipy.sparse.issparse(matrix) else matrix


def _with_residuals(
    k: Any,
    m: Any,
    squared: np.ndarray,
    shapes: np.ndarray,
    rigid: np.ndarray,
    loads: list[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """The modes with residual vectors: static response of the truncated modes to unit loads."""
    if shapes.shape[1] + rigid.shape[1] >= len(shapes):
        return squared, shapes
    kept = np.concatenate([rigid, shapes], axis=1)
    columns = np.stack(loads, axis=1)
    columns = columns - m @ (kept @ (kept.T @ columns))  # orthogonal to the kept modes
    stiffness: Any = k
    right = columns
    if rigid.shape[1]:  # constraints fix the rigid-body motion, which these loads do not excite
        constraint = m @ rigid * (np.abs(k.diagonal()).max() / np.abs(m @ rigid).max())
        sparse = scipy.sparse.issparse(k)
        blocks = [
            [k, constraint],
            [constraint.T, None if sparse else np.zeros((rigid.shape[1],) * 2)],
        ]
        stiffness = scipy.sparse.block_array(blocks, format="csc") if sparse else np.block(blocks)
        right = np.pad(columns, ((0, rigid.shape[1]), (0, 0)))
    deflections = _Inverse(stiffness).solve(right)[: len(shapes)]
    vectors = np.zeros((len(shapes), 0))
    for deflection in deflections.T:
        vector = deflection
        for _ in range(2):  # reorthogonalised against rounding
            for basis in (kept, vectors):
                vector = vector - basis @ (basis.T @ (m @ vector))
        norm, whole = np.sqrt(vector @ (m @ vector)), np.sqrt(deflection @ (m @ deflection))
        if norm > _DEPENDENT * max(whole, np.finfo(float).tiny):
            vectors = np.column_stack([vectors, vector / norm])
    if not vectors.shape[1]:
        return squared, shapes
    values, mixed = np.linalg.eigh(vectors.T @ (k @ vectors))
    return np.append(squared, values), np.column_stack([shapes, vectors @ mixed])


def chain(
    masses: Sequence[float] | Float[np.ndarray, " mass"],
    springs: Sequence[float] | Float[np.ndarray, " spring"],
    dampers: Sequence[float] | Float[np.ndarray, " spring"] | float = 0.0,
) -> Matrices:
    """A spring–mass chain between two walls; its points are "x1", "x2", ….

    Arguments: `masses` in kg; `springs` in N/m and `dampers` in N s/m, one more than masses: wall
    to first, first to second, …, last to wall (0 for none). A scalar `dampers` applies to all.
    Raises `ValueError` for inconsistent lengths.

    >>> chain([1.0, 2.0], [3.0, 4.0, 0.0]).stiffness
    array([[ 7., -4.],
           [-4.,  4.]])
    """
    weights = np.asarray(masses, dtype=np.float64)
    size = weights.size
    parts = []
    for name, values in (("springs", springs), ("dampers", dampers)):
        row = np.asarray(values, dtype=np.float64)
        row = np.full(size + 1, row) if row.ndim == 0 else row
        if row.shape != (size + 1,):
            raise InputError(
                f"`{name}` must have {size + 1} numbers, one more than masses, but has {row.size}."
            )
        parts.append(np.diag(row[:-1] + row[1:]) - np.diag(row[1:-1], 1) - np.diag(row[1:-1], -1))
    names = tuple(f"x{i + 1}" for i in range(size))
    return Matrices(np.diag(weights), parts[1], parts[0], names)


def beam(
    bending_stiffness: float,
    mass_per_length: float,
    length: float,
    n_elements: int,
    *,
    supports: tuple[str, str] = ("clamped", "free"),
    springs: Mapping[str, float] | None = None,
    stiffness_damping: float = 0.0,
    mass_damping: float = 0.0,
) -> Matrices:
    """A straight beam in bending by Euler–Bernoulli elements with consistent mass matrices.

    The points are the deflections "w0", "w1", …, "w`n_elements`" (m) and the slopes "r0", "r1", …
    (rad) of the nodes, without those fixed by `supports`: "clamped", "pinned" or "free" at either
    end. `springs` (N/m) are linear springs to ground at points; the damping is `mass_damping` (1/s)
    times the mass and `stiffness_damping` (s) times the stiffness of the beam without springs.
    Arguments: `bending_stiffness` E I in N m², `mass_per_length` ρ A in kg/m, `length` in m.
    Raises `ValueError` for numbers that are not positive and unknown supports.

    >>> model = from_matrices(*beam(174.3, 0.78, 0.5, 20), force="w20")
    >>> round(float(model.modes.natural_frequency[0]), 2)  # 1.8751²/l² √(E I/ρ A)
    210.24
    """
    for name, value in (
        *(("bending_stiffness", bending_stiffness), ("mass_per_length", mass_per_length)),
        *(("length", length), ("n_elements", n_elements)),
    ):
        require(f"`{name}`", value, POSITIVE)
    h = length / n_elements
    bending = np.array([[12, 6 * h, -12, 6 * h], [0, 4 * h**2, -6 * h, 2 * h**2]])
    bending = np.vstack([bending, [[0, 0, 12, -6 * h], [0, 0, 0, 4 * h**2]]])
    inertia = np.array([[156, 22 * h, 54, -13 * h], [0, 4 * h**2, 13 * h, -3 * h**2]])
    inertia = np.vstack([inertia, [[0, 0, 156, -22 * h], [0, 0, 0, 4 * h**2]]])
    size = 2 * n_elements + 2
    mass, stiffness = np.zeros((size, size)), np.zeros((size, size))
    for k in range(n_elements):
        dofs = slice(2 * k, 2 * k + 4)
        mass[dofs, dofs] += mass_per_length * h / 420 * inertia
        stiffness[dofs, dofs] += bending_stiffness / h**3 * bending
    mass, stiffness = (np.triu(part) + np.triu(part, 1).T for part in (mass, stiffness))
    names = [f"{kind}{k}" for k in range(n_elements + 1) for kind in "wr"]
    fixed = {"clamped": 2, "pinned": 1, "free": 0}
    for end in supports:
        if end not in fixed:
            raise InputError(f"`supports` must be clamped, pinned or free, but has {end!r}.")
    removed = [*range(fixed[supports[0]]), *(size - 2 + k for k in range(fixed[supports[1]]))]
    keep = np.setdiff1d(np.arange(size), removed)
    mass, stiffness = mass[np.ix_(keep, keep)], stiffness[np.ix_(keep, keep)]
    points = tuple(names[k] for k in keep)
    damping = mass_damping * mass + stiffness_damping * stiffness
    for point, value in (springs or {}).items():
        (dof,) = _indices(points, [point], "`springs`")
        stiffness[dof, dof] += value
    return Matrices(mass, damping, stiffness, points)
