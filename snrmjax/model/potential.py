"""Polynomial restoring forces as the gradient of one potential."""

import itertools
import operator
from collections.abc import Mapping
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.numerics.rules import InputError

Monomial = tuple[int, ...]


class PolynomialPotential(eqx.Module):
    """V(q) = Σ c_k Π q_i over the modes i of monomial k; the restoring force is f_m = ∂V/∂q_m.

    A monomial is the sorted tuple of its modes, counted from zero: (0, 0, 1) is q₁²q₂.
    The linear stiffness belongs to the linear modes and is not included.
    """

    coefficient: Float[Array, " monomial"]
    coefficient_std: Float[Array, " monomial"]
    monomials: tuple[Monomial, ...] = eqx.field(static=True)
    n_modes: int = eqx.field(static=True)

    @property
    def degree(self) -> int:
        """Highest degree of the potential (0 when it is empty)."""
        return max((len(m) for m in self.monomials), default=0)

    def energy(
        self, displacement: Float[Array | np.ndarray, "*batch mode"]
    ) -> Float[Array, "*batch"]:
        """Potential energy in J, without that of the linear stiffness."""
        return _products(displacement, self.monomials) @ self.coefficient

    def force(self, displacement: Float[Array, "*batch mode"]) -> Float[Array, "*batch mode"]:
        """Restoring force ∂V/∂q, in the modal unit kg^1/2 m/s²."""
        basis, coefficients = self._gradient
        return _products(displacement, basis) @ coefficients

    def stiffness(
        self, displacement: Float[Array, "*batch mode"]
    ) -> Float[Array, "*batch mode mode"]:
        """Tangent stiffness ∂²V/∂q∂q, in 1/s²."""
        n, (basis, coefficients) = self.n_modes, self._hessian
        flat = _products(displacement, basis) @ coefficients
        return flat.reshape(*displacement.shape[:-1], n, n)

    def force_of_rows(
        self, displacement: Float[Array, "mode sample"]
    ) -> Float[Array, "mode sample"]:
        """As `force`, with the samples along the last axis, which vectorises better."""
        basis, coefficients = self._gradient
        return coefficients.T @ _products(displacement, basis, by_rows=True)

    def stiffness_of_rows(
        self, displacement: Float[Array, "mode sample"]
    ) -> Float[Array, "mode mode sample"]:
        """As `stiffness`, with the samples along the last axis."""
        n, (basis, coefficients) = self.n_modes, self._hessian
        flat = coefficients.T @ _products(displacement, basis, by_rows=True)
        return flat.reshape(n, n, displacement.shape[1])

    @property
    def _gradient(self) -> tuple[tuple[Monomial, ...], Float[Array, "monomial mode"]]:
        basis, *given = _derivative_map(self.monomials, self.n_modes)
        return basis, self._derived(*given)

    @property
    def _hessian(self) -> tuple[tuple[Monomial, ...], Float[Array, "monomial pair"]]:
        basis, *given = _second_derivative_map(self.monomials, self.n_modes)
        return basis, self._derived(*given)

    def _derived(self, monomial: np.ndarray, factor: np.ndarray) -> Float[Array, "monomial column"]:
        """Coefficients of a derivative: each is a coefficient of the potential times a factor."""
        xp = np if isinstance(self.coefficient, np.ndarray) else jnp
        return xp.append(self.coefficient, 0.0)[monomial] * factor


def polynomial_potential(
    coefficients: Mapping[str, float] | Mapping[Monomial, float],
    n_modes: int,
    *,
    coefficient_std: Mapping[str, float] | Mapping[Monomial, float] | None = None,
) -> PolynomialPotential:
    """Build a potential from its monomials.

    Arguments: `coefficients` maps a monomial to its coefficient; a monomial is either a text of
    mode numbers counted from one ("1112" is q₁³q₂; with modes above 9, "1-1-12") or a tuple of
    indices counted from zero. `coefficient_std` gives 1σ for some of them.
    Raises `ValueError` for a monomial of degree below 2, with unknown modes, or repeated in
    another order, and for a coefficient that is not finite.

    >>> duffing = polynomial_potential({"1111": 0.25}, 1)
    >>> duffing.force(jnp.array([2.0]))
    Array([8.], dtype=float64)
    """
    values = _by_monomial(coefficients, n_modes)
    spread = _by_monomial(coefficient_std or {}, n_modes)
    unknown = set(spread) - set(values)
    if unknown:
        raise InputError(f"`coefficient_std` names {sorted(unknown)}, which have no coefficient.")
    monomials = tuple(sorted(values, key=lambda m: (len(m), m)))
    return PolynomialPotential(
        coefficient=jax.device_put(np.array([values[m] for m in monomials], float)),
        coefficient_std=jax.device_put(np.array([spread.get(m, 0.0) for m in monomials], float)),
        monomials=monomials,
        n_modes=n_modes,
    )


def _by_monomial(
    numbers: Mapping[str, float] | Mapping[Monomial, float], n_modes: int
) -> dict[Monomial, float]:
    values: dict[Monomial, float] = {}
    for key, value in numbers.items():
        monomial = parse_monomial(key, n_modes)
        if monomial in values:
            raise InputError(f"monomial {key!r} is given twice (the order of modes is free).")
        if not np.isfinite(value):
            raise InputError(f"the number of monomial {key!r} must be finite, but is {value}.")
        values[monomial] = float(value)
    return values


def parse_monomial(key: str | Monomial, n_modes: int) -> Monomial:
    """The sorted, zero-based modes of a monomial written "1112", "1-1-12" or (0, 0, 0, 1)."""
    if isinstance(key, str):
        parts = key.split("-") if "-" in key else list(key)
        if not all(part.isascii() and part.isdigit() for part in parts):
            raise InputError(f'monomial {key!r} must be mode numbers, such as "112" for q1^2 q2.')
        indices = [int(part) - 1 for part in parts]
    else:
        indices = [operator.index(index) for index in key]
    if len(indices) < 2:
        raise InputError(f"monomial {key!r} must have degree 2 or more.")
    if not all(0 <= index < n_modes for index in indices):
        raise InputError(
            f"monomial {key!r} names a mode that does not exist (there are {n_modes})."
        )
    return tuple(sorted(indices))


def monomial_key(monomial: Monomial) -> str:
    """A monomial as written in files: mode numbers counted from one, "112" or "1-1-12"."""
    numbers = [str(index + 1) for index in monomial]
    return "".join(numbers) if all(len(n) == 1 for n in numbers) else "-".join(numbers)


def _products(
    displacement: Float[Array | np.ndarray, "..."],
    monomials: tuple[Monomial, ...],
    *,
    by_rows: bool = False,
) -> Float[Array, "..."]:
    """Π q_i of every monomial along the axis of the modes, the last or the first."""
    axis, before = (0, ()) if by_rows else (-1, (...,))
    if not monomials:
        shape = list(displacement.shape)
        shape[axis] = 0
        return jnp.zeros(shape, dtype=displacement.dtype)
    # Monomials of lower degree are filled up with a padded factor of one (index n).
    index = _factors(monomials, displacement.shape[axis])
    # NumPy arrays stay in NumPy, so that nothing is compiled.
    xp = np if isinstance(displacement, np.ndarray) else jnp
    ones = xp.ones_like(displacement[(*before, slice(0, 1))])
    padded = xp.concatenate([displacement, ones], axis=axis)
    product = padded[(*before, index[:, 0])]
    for column in range(1, index.shape[1]):
        product = product * padded[(*before, index[:, column])]
    return product


def _factors(monomials: tuple[Monomial, ...], n_modes: int) -> np.ndarray:
    """The modes of every monomial as a row, filled up with the index of the padded one."""
    index = np.full((len(monomials), max(1, max(len(m) for m in monomials))), n_modes)
    for row, monomial in enumerate(monomials):
        index[row, : len(monomial)] = monomial
    return index


Derivative = tuple[tuple[Monomial, ...], np.ndarray, np.ndarray]


@lru_cache(maxsize=256)
def _derivative_map(monomials: tuple[Monomial, ...], n_modes: int) -> Derivative:
    """Monomials of the gradient, and for each coefficient its index in the potential and factor."""
    entries: list[tuple[int, Monomial, int, float]] = []
    for k, monomial in enumerate(monomials):
        for mode in sorted(set(monomial)):
            rest = list(monomial)
            rest.remove(mode)
            entries.append((k, tuple(rest), mode, float(monomial.count(mode))))
    return _assemble(entries, len(monomials), n_modes)


@lru_cache(maxsize=256)
def _second_derivative_map(monomials: tuple[Monomial, ...], n_modes: int) -> Derivative:
    """As `_derivative_map`, for the Hessian."""
    entries: list[tuple[int, Monomial, int, float]] = []
    for k, monomial in enumerate(monomials):
        for i, j in itertools.product(sorted(set(monomial)), repeat=2):
            if monomial.count(j) < (2 if i == j else 1):
                continue
            rest = list(monomial)
            rest.remove(i)
            factor = monomial.count(i) * rest.count(j)
            rest.remove(j)
            entries.append((k, tuple(rest), i * n_modes + j, float(factor)))
    return _assemble(entries, len(monomials), n_modes**2)


def _assemble(
    entries: list[tuple[int, Monomial, int, float]], n_monomials: int, n_columns: int
) -> Derivative:
    basis = tuple(sorted({rest for _, rest, _, _ in entries}, key=lambda m: (len(m), m)))
    where = {rest: row for row, rest in enumerate(basis)}
    # A zero coefficient is taken from behind the last monomial.
    monomial = np.full((len(basis), n_columns), n_monomials)
    factors = np.zeros((len(basis), n_columns))
    for k, rest, column, factor in entries:
        monomial[where[rest], column], factors[where[rest], column] = k, factor
    return basis, monomial, factors
