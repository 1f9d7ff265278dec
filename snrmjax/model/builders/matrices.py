"""Structures from their mass, damping and stiffness matrices."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from snrmjax.model.builders.free_coordinates import felt_first
from snrmjax.model.builders.modal_damping import modal_damping
from snrmjax.model.effect_base import AbstractEffect, AbstractForce, checked_effects
from snrmjax.model.modes import Beside, LinearModesStd, RigidBodyModes, linear_modes
from snrmjax.model.moving_base import BaseMotion
from snrmjax.model.places import Row, row_over_points
from snrmjax.model.structures import Structure, structure
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import POSITIVE, require

_SYMMETRIC = 1e-8  # of the largest entry: what a finite-element program's output may miss by
_RIGID = 1e-9  # of the largest of a few: natural frequencies squared below are of rigid motions
_ROUNDING = 2e-14  # of the largest entry, for every unknown: what rounding leaves of zero
_SMALL = 100  # unknowns, above which a few modes are found by themselves
_MORE, _PASSES = 6, 4  # modes beside those wanted; shifts that are tried
_DEPENDENT = 1e-10  # of its length: what is left of a vector that others already contain
_DENSE = 2000  # unknowns, above which only the wanted modes are computed

Phasor = float | complex


class Matrices(NamedTuple):
    """M ẍ + C ẋ + K x = f, as `from_matrices` takes it."""

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
    """A structure from matrices, by its linear modes: M ẍ + C ẋ + K x + Σ effects = b F cos Ωt.

    Arguments: `mass` (kg), `damping` (N s/m) and `stiffness` (N/m) of shape (unknown, unknown),
    dense or sparse of SciPy; `damping` may be a damping ratio of every mode instead, and None for
    none. `points` names the unknowns ("x1", "x2", … by default). `force` is where the recorded
    force acts: a point, or newtons per newton at points, complex where they lead by a phase.
    `base` in its place: the structure stands on a base that moves, whose acceleration a acts as
    the force −M r a, r being how far each unknown goes with the base (`base_motion`'s `along`); all
    motion, that of the effects too, is relative to it.
    `unbalance` (kg m) of something that turns: the force is U Ω² then, at the points of `force`.
    `effects` act at points by their `at`, in N and m; the matrices hold no part of them.
    `n_modes` keeps so many modes of lowest frequency, and for every place of an effect and for
    the force one vector more: what the left out modes give way there statically, exactly, as
    further modes of high frequency; without `residuals` it does not, as many places want it.
    `sensors` are the points that are watched, by default all.
    Damping that couples modes is kept. Modes without stiffness become rigid-body modes; those that
    an effect acts on become modes of zero frequency, behind the others: masses without a linear
    spring, which only nonlinear elements connect, as those of a nonlinear absorber.

    Returns a `Structure`. What `n_modes` leaves out is the dynamics of higher modes: a share of
    about (Ω/ω)² of their static part, ω being the first frequency left out, for each harmonic Ω.
    Raises `ValueError` for matrices that are not square, finite, symmetric, or of different sizes,
    a mass that is not positive definite, a stiffness that is negative, unknown or repeated points,
    a force or base that moves no mode, and both or none of them.
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
        raise ValueError(f"`mass` has shape {m.shape}, but `stiffness` has {k.shape}.")
    names = tuple(points) if points is not None else tuple(f"x{i + 1}" for i in range(size))
    check_names(names, size)
    made = checked_effects(effects)
    forces = [effect for effect in made if isinstance(effect, AbstractForce)]
    places = dict.fromkeys(row for e in forces for row in e.rows if row is not None)
    rows = [_column(names, row, "an effect") for row in places]
    load = _load(m, names, force, base)
    squared, shapes, rigid = _modes(m, k, n_modes)
    if n_modes is not None and residuals:
        parts = [*rows, load.real, *([load.imag] if np.any(load.imag) else [])]
        squared, shapes = _with_residuals(k, m, squared, shapes, rigid, parts)
    n_flexible = len(squared)
    if rigid.shape[1] and rows:
        # What only elements hold moves with them, as an absorber without a linear spring does.
        turn, n_free = felt_first(np.stack(rows) @ rigid, np.abs(rigid).max(axis=0))
        free, rigid = np.split(rigid @ turn, [n_free], axis=1)
        squared, shapes = np.pad(squared, (0, n_free)), np.concatenate([shapes, free], axis=1)
    if not n_flexible or not np.any(load @ shapes):
        raise ValueError(
            "the force acts where no mode of the structure moves."
            if base is None
            else "the base moves no mode of the structure."
        )
    omega = np.sqrt(squared)
    if damping is None or (np.ndim(damping) == 0 and not scipy.sparse.issparse(damping)):
        ratio = np.where(omega > 0, 0.0 if damping is None else float(damping), 0.0)
        coupling, ratio_std = None, np.zeros(omega.shape)
    else:
        c = _checked("damping", damping)
        if c.shape != m.shape:
            raise ValueError(f"`damping` has shape {c.shape}, but there are {size} unknowns.")
        ratio, coupling, ratio_std = modal_damping(c, m, k, shapes, omega)
    watched = tuple(sensors) if sensors is not None else names
    seen = np.array(_places(names, watched, "`sensors`"))
    unseen = np.setdiff1d(np.arange(size), seen).tolist()
    other = {names[i]: shapes[i] for i in unseen}
    acting = load @ shapes
    modes = linear_modes(
        *(omega, ratio, shapes[seen], acting.real),
        sensors=watched,
        mode_of_interest=mode_of_interest,
        rigid_body=RigidBodyModes(rigid[seen], (load @ rigid).real),
        std=LinearModesStd(damping_ratio=ratio_std),
        beside=Beside(
            other, coupling, -acting.imag if np.any(acting.imag) else None, base, unbalance
        ),
    )
    return structure(modes, effects=made, name=name)


def _load(
    mass: Any,
    names: tuple[str, ...],
    force: str | Mapping[str, Phasor] | None,
    base: BaseMotion | None,
) -> np.ndarray:
    """Newtons at the unknowns per newton, or per m/s² of the base."""
    if (force is None) == (base is None):
        raise ValueError("a structure has either a `force` or a `base` that moves.")
    if base is None:
        return _column(names, force or {}, "`force`")
    _places(names, [point for point, _ in base.along], "the base's `along`")
    return -(mass @ base.cosines(names))


def _checked(name: str, matrix: Any) -> Any:
    """A square symmetric matrix, dense up to a size and sparse beyond."""
    if matrix is None:
        raise ValueError(f"`{name}` must be a matrix, but is missing.")
    sparse = scipy.sparse.issparse(matrix)
    values: Any = matrix.tocsc().astype(float) if sparse else np.asarray(matrix, dtype=np.float64)
    if values.ndim != 2 or values.shape[0] != values.shape[1] or not values.shape[0]:
        raise ValueError(f"`{name}` must be a square matrix, but has shape {values.shape}.")
    require(f"`{name}`", values.data if sparse else values)
    miss, largest = abs(values - values.T).max(), abs(values).max()
    if miss > _SYMMETRIC * largest:
        raise ValueError(f"`{name}` must be symmetric, but its two halves differ by {miss:g}.")
    values = 0.5 * (values + values.T)
    return values.toarray() if sparse and values.shape[0] <= _DENSE else values


def check_names(names: Sequence[str], size: int) -> None:
    """Refuse names of points that are not as many as unknowns, or not different."""
    if len(names) != size:
        raise ValueError(f"`points` names {len(names)} points, but there are {size} unknowns.")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise ValueError(f"`points` names {name!r} twice.")


def _places(names: tuple[str, ...], points: Iterable[str], what: str) -> list[int]:
    """Where points are among the unknowns."""
    place = {name: k for k, name in enumerate(names)}
    for point in points:
        if point not in place:
            near = suggestion(point, names) or f"; known are {', '.join(names[:12])}"
            raise ValueError(f"{what} names the point {point!r}, which does not exist{near}.")
    return [place[point] for point in points]


def _column(names: tuple[str, ...], at: str | Mapping[str, Phasor] | Row, what: str) -> np.ndarray:
    """Weights of all unknowns; complex of a force with phases."""
    weights = dict(at.items() if isinstance(at, Mapping) else row_over_points(at))
    column = np.zeros(len(names), dtype=complex)
    column[_places(names, weights, what)] = list(weights.values())
    return column if np.any(column.imag) else column.real


def _modes(m: Any, k: Any, n_modes: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared frequencies and mass-normalised shapes of flexible modes, and rigid-body shapes."""
    size = m.shape[0]
    wanted = size if n_modes is None else n_modes
    if not 1 <= wanted <= size:
        raise ValueError(f"`n_modes` must lie between 1 and {size}, but is {n_modes}.")
    if wanted + _MORE < size and (scipy.sparse.issparse(k) or size > _SMALL):
        squared, shapes = _lowest_modes(m, k, wanted + _MORE)
        rigid = _RIGID * squared.max()
    else:
        try:
            squared, shapes = scipy.linalg.eigh(_dense(k), _dense(m))
        except np.linalg.LinAlgError as error:
            raise ValueError("`mass` must be positive definite, but is not.") from error
        rigid = max(_ROUNDING * size * squared.max(), np.finfo(float).tiny)
    order = np.argsort(squared)
    squared, shapes = squared[order], shapes[:, order]
    if squared[0] < -rigid:
        raise ValueError(
            "`stiffness` must not be negative, but one of the squared natural frequencies is "
            f"{squared[0]:g} 1/s²: what displacements are counted from is no stable position of "
            "rest. Write the model about one, x = x₀ + y, where all springs together exert no "
            "force: k x + c x³ with k < 0 rests at x₀ = √(−k/c), and has there the stiffness −2k, "
            "a quadratic spring 3 c x₀ and the cubic spring c."
        )
    shapes = shapes * np.where(shapes[np.argmax(np.abs(shapes), 0), range(len(order))] < 0, -1, 1)
    floats = squared <= rigid
    keep = np.flatnonzero(~floats)[:wanted]
    return squared[keep], shapes[:, keep], shapes[:, floats]


def _lowest_modes(m: Any, k: Any, wanted: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest modes by Lanczos' method on the inverse, rigid-body modes among them.

    A shift as large as the lowest natural frequency squared loses no digits of it; one that is far
    larger, as entries of a fine mesh suggest, loses all.
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
            raise ValueError(
                "the lowest modes are lost to rounding: the mesh is too fine for these matrices, "
                "or `stiffness` and `mass` have motions in common that neither holds."
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
        size = np.abs(pivots)
        # A motion without a force leaves a pivot of rounding.
        self.regular = bool(size.min() > _ROUNDING * size.max())


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
    """The modes, and what the left out ones give way statically under unit loads, as modes."""
    if shapes.shape[1] + rigid.shape[1] >= len(shapes):
        return squared, shapes
    kept = np.concatenate([rigid, shapes], axis=1)
    columns = np.stack(loads, axis=1)
    columns = columns - m @ (kept @ (kept.T @ columns))  # nothing that the kept modes carry
    stiffness: Any = k
    right = columns
    if rigid.shape[1]:  # further equations fix the rigid motion, which these loads do not drive
        held = m @ rigid * (np.abs(k.diagonal()).max() / np.abs(m @ rigid).max())
        sparse = scipy.sparse.issparse(k)
        rows = [[k, held], [held.T, None if sparse else np.zeros((rigid.shape[1],) * 2)]]
        stiffness = scipy.sparse.block_array(rows, format="csc") if sparse else np.block(rows)
        right = np.pad(columns, ((0, rigid.shape[1]), (0, 0)))
    ways = _Inverse(stiffness).solve(right)[: len(shapes)]
    vectors = np.zeros((len(shapes), 0))
    for way in ways.T:
        left = way
        for _ in range(2):  # once more against rounding
            for basis in (kept, vectors):
                left = left - basis @ (basis.T @ (m @ left))
        length, whole = np.sqrt(left @ (m @ left)), np.sqrt(way @ (m @ way))
        if length > _DEPENDENT * max(whole, np.finfo(float).tiny):
            vectors = np.column_stack([vectors, left / length])
    if not vectors.shape[1]:
        return squared, shapes
    values, mixed = np.linalg.eigh(vectors.T @ (k @ vectors))
    return np.append(squared, values), np.column_stack([shapes, vectors @ mixed])


def chain(
    masses: Sequence[float] | Float[np.ndarray, " mass"],
    springs: Sequence[float] | Float[np.ndarray, " spring"],
    dampers: Sequence[float] | Float[np.ndarray, " spring"] | float = 0.0,
) -> Matrices:
    """Masses in a row between two walls; their points are "x1", "x2", ….

    Arguments: `masses` in kg; `springs` in N/m and `dampers` in N s/m, one more than masses: wall
    to first, first to second, …, last to wall (0 for none). One number of `dampers` is for all.
    Raises `ValueError` for numbers that do not fit together.

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
            raise ValueError(
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
    """A straight beam in bending by Euler and Bernoulli's elements, with consistent masses.

    The points are the deflections "w0", "w1", …, "w`n_elements`" (m) and the slopes "r0", "r1", …
    (rad) of the nodes, but for those that `supports` hold: "clamped", "pinned" or "free" at either
    end. `springs` (N/m) stand at points, linear; the damping is `mass_damping` (1/s) times the mass
    and `stiffness_damping` (s) times the stiffness of the beam without springs.
    Arguments: `bending_stiffness` E I in N m², `mass_per_length` ρ A in kg/m, `length` in m.
    Raises `ValueError` for numbers that cannot be and unknown supports.

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
        here = slice(2 * k, 2 * k + 4)
        mass[here, here] += mass_per_length * h / 420 * inertia
        stiffness[here, here] += bending_stiffness / h**3 * bending
    mass, stiffness = (np.triu(part) + np.triu(part, 1).T for part in (mass, stiffness))
    names = [f"{kind}{k}" for k in range(n_elements + 1) for kind in "wr"]
    held = {"clamped": 2, "pinned": 1, "free": 0}
    for end in supports:
        if end not in held:
            raise ValueError(f"`supports` must be clamped, pinned or free, but has {end!r}.")
    gone = [*range(held[supports[0]]), *(size - 2 + k for k in range(held[supports[1]]))]
    keep = np.setdiff1d(np.arange(size), gone)
    mass, stiffness = mass[np.ix_(keep, keep)], stiffness[np.ix_(keep, keep)]
    points = tuple(names[k] for k in keep)
    damping = mass_damping * mass + stiffness_damping * stiffness
    for point, value in (springs or {}).items():
        (place,) = _places(points, [point], "`springs`")
        stiffness[place, place] += value
    return Matrices(mass, damping, stiffness, points)
