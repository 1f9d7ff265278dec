"""Harmonic balance of a structure: residual and analytic Jacobian.

Unknowns are scaled to order one: displacement coefficients by a displacement, the frequency by
the natural frequency of the mode of interest, and the residual accordingly.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.averaging import averaged_force
from snrmjax.model.structure import Structure
from snrmjax.simulate.harmonics import alias_free_samples, harmonic_basis, squared_orders


class HarmonicBalance(eqx.Module):
    """The balance R(x, λ) = 0 of one structure under one force, or of its normal modes.

    `x` holds the (coefficient, mode) displacements divided by `displacement_scale`, flattened;
    λ is the frequency divided by `frequency_scale`. Without a force and with `cosine_only` the
    solutions are the conservative normal modes (damping and velocities are left out).
    """

    model: Structure
    force: Float[Array, ""]  # N, amplitude of a cosine
    displacement_scale: Float[Array, ""]  # kg^1/2 m
    frequency_scale: Float[Array, ""]  # rad/s
    harmonic_order: int = eqx.field(static=True)
    n_samples: int = eqx.field(static=True)
    cosine_only: bool = eqx.field(static=True, default=False)

    @property
    def n_coefficients(self) -> int:
        """Fourier coefficients of one mode."""
        return self.harmonic_order + 1 if self.cosine_only else 2 * self.harmonic_order + 1

    @property
    def size(self) -> int:
        """Number of equations."""
        return self.n_coefficients * self.model.n_modes

    def coefficients(self, point: Float[Array, " unknown"]) -> Float[Array, "coefficient mode"]:
        """Unscaled displacement coefficients of a point (x, λ), in kg^1/2 m."""
        flat = point[: self.size] * self.displacement_scale
        return flat.reshape(self.n_coefficients, self.model.n_modes)

    def point(
        self, coefficients: Float[Array, "coefficient mode"], frequency: Float[Array, ""]
    ) -> Float[Array, " unknown"]:
        """The scaled point (x, λ) of unscaled coefficients and a frequency in rad/s."""
        scaled = coefficients.reshape(-1) / self.displacement_scale
        return jnp.append(scaled, frequency / self.frequency_scale)

    def residual(self, point: Float[Array, " unknown"]) -> Float[Array, " equation"]:
        """R(x, λ): force balance of every coefficient over ω²·displacement scale."""
        return self._balance(point, with_jacobian=False)[0]

    def linearised(
        self, point: Float[Array, " unknown"]
    ) -> tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]:
        """R(x, λ) and its Jacobian with respect to (x, λ), the last column for λ."""
        return self._balance(point, with_jacobian=True)

    def _balance(self, point: Array, *, with_jacobian: bool) -> tuple[Array, Array]:
        model, modes = self.model, self.model.modes
        n, size = model.n_modes, self.n_coefficients
        basis = harmonic_basis(self.harmonic_order, self.n_samples, cosine_only=self.cosine_only)
        x = self.coefficients(point)
        omega = point[-1] * self.frequency_scale
        stiffness = modes.natural_frequency**2
        damping = 2 * modes.damping_ratio * modes.natural_frequency
        h2 = squared_orders(self.harmonic_order, cosine_only=self.cosine_only)[:, None]
        samples = jnp.asarray(basis.synthesis) @ x
        rate = omega * (jnp.asarray(basis.synthesis @ basis.derivative) @ x)
        slope = basis.derivative @ x
        load = jnp.zeros((size, n)).at[1].set(self.force * modes.participation)
        balance = (
            (stiffness - h2 * omega**2) * x
            + omega * damping * slope
            + basis.analysis @ model.nonlinear_force(samples, rate)
            - load
        )
        unit = self.frequency_scale**2 * self.displacement_scale
        residual = balance.reshape(-1) / unit
        if not with_jacobian:
            return residual, jnp.zeros((0,))
        tangent = model.tangent_stiffness(samples, rate).reshape(self.n_samples, n * n)
        blocks = (jnp.asarray(basis.product) @ tangent).reshape(size, size, n, n)
        linear = (
            jnp.diag(jnp.ones(size))[:, :, None] * stiffness
            - jnp.diag(h2[:, 0])[:, :, None] * omega**2
            + omega * jnp.asarray(basis.derivative)[:, :, None] * damping
        )
        blocks = blocks + linear[..., None] * jnp.eye(n)
        by_frequency = -2 * omega * h2 * x + damping * slope
        if model.effects:
            j = modes.mode_of_interest
            viscous = model.tangent_damping(samples, rate)
            own = omega * (basis.product_rate @ viscous).reshape(size, size)
            blocks = blocks.at[:, :, j, j].add(own)
            by_frequency = by_frequency.at[:, j].add(
                basis.analysis @ (viscous * rate[:, j] / omega)
            )
        by_x = blocks.transpose(0, 2, 1, 3).reshape(size * n, size * n)
        columns = [
            by_x * (self.displacement_scale / unit),
            by_frequency.reshape(-1, 1) * (self.frequency_scale / unit),
        ]
        return residual, jnp.concatenate(columns, axis=1)


def harmonic_balance(
    model: Structure,
    force: Float[Array, ""] | float,
    displacement_scale: Float[Array, ""] | float,
    *,
    harmonic_order: int,
    n_samples: int | None = None,
    cosine_only: bool = False,
) -> HarmonicBalance:
    """The balance of `model` under a cosine force of amplitude `force` (N).

    `n_samples` defaults to the alias-free number for a polynomial potential and to at least
    128 when there are effects, whose forces are not polynomial.
    Raises `ValueError` when `harmonic_order` is below 1 or the samples are too few to tell the
    harmonics apart.
    """
    if harmonic_order < 1:
        raise ValueError(f"`harmonic_order` must be 1 or more, but is {harmonic_order}.")
    if n_samples is not None and n_samples <= 2 * harmonic_order:
        raise ValueError(
            f"`n_samples` must be above {2 * harmonic_order}, twice the harmonic order, "
            f"but is {n_samples}."
        )
    if n_samples is None:
        n_samples = alias_free_samples(harmonic_order, max(model.potential.degree - 1, 1))
        if model.effects:
            n_samples = max(n_samples, 128, 16 * harmonic_order)
    modes = model.modes
    return HarmonicBalance(
        model=model,
        force=jnp.asarray(force, dtype=jnp.float64),
        displacement_scale=jnp.asarray(displacement_scale, dtype=jnp.float64),
        frequency_scale=modes.natural_frequency[modes.mode_of_interest],
        harmonic_order=harmonic_order,
        n_samples=n_samples,
        cosine_only=cosine_only,
    )


def linear_coefficients(
    model: Structure, force: Float[Array, ""], frequency: Float[Array, ""], harmonic_order: int
) -> Float[Array, "coefficient mode"]:
    """Displacement coefficients of the linear response: where a forced response starts."""
    modes = model.modes
    stiffness = (
        modes.natural_frequency**2
        - frequency**2
        + 2j * modes.damping_ratio * modes.natural_frequency * frequency
    )
    phasor = force * modes.participation / stiffness
    start = jnp.zeros((2 * harmonic_order + 1, model.n_modes))
    return start.at[1].set(phasor.real).at[2].set(-phasor.imag)


def resonance_displacement(model: Structure, force: float) -> float:
    """Rough displacement (kg^1/2 m) of the mode of interest at resonance: a scale, no result.

    Solves 2ζ̃ω̃ ω̃ Q = |P| with ω̃² = ω₀² + ¾·4c Q² from the mode's own quartic term, and with the
    averages of the effects. The damping counts as at least that of ζ = 5e-5, and the scale is
    at least the static displacement of every mode, so that no motion is small beside it.
    """
    modes, j = model.modes, model.modes.mode_of_interest
    omega = float(modes.natural_frequency[j])
    least_damping = 1e-4 * omega
    damping = 2 * float(modes.damping_ratio[j]) * omega
    load = abs(force * float(modes.participation[j]))
    own = dict(zip(model.potential.monomials, np.asarray(model.potential.coefficient), strict=True))
    quartic = max(3.0 * float(own.get((j,) * 4, 0.0)), 0.0)
    static = np.max(np.abs(force * np.asarray(modes.participation / modes.natural_frequency**2)))
    if load == 0:
        return float(static)
    amplitude = load / (max(damping, least_damping) * omega) * np.logspace(-9, 0, 361)
    stiffness, viscous = omega**2 + quartic * amplitude**2, np.full(amplitude.shape, damping)
    for effect in model.effects:
        average = averaged_force(
            effect.force, jnp.asarray(amplitude), jnp.asarray(omega), n_samples=128
        )
        stiffness = stiffness + np.maximum(average.stiffness, 0.0)
        viscous = viscous + np.asarray(average.damping)
    needed = np.maximum(viscous, least_damping) * np.sqrt(stiffness) * amplitude
    return float(np.maximum(static, np.interp(load, np.maximum.accumulate(needed), amplitude)))
