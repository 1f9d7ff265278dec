"""Polynomial nonlinear state-space models in discrete time, in modal coordinates.

x(k+1) = A x(k) + B u(k) + E ζ(x(k)), y(k) = C x(k) + D u(k), with ζ all monomials of some degrees.
A has a block [[p, q], [−q, p]] and C a block (1, 0) for each oscillating mode. Every model of such
modes has this form, which fixes the coordinates: the fitted coefficients are unique.

References: J. Paduart et al., Automatica 46 (2010) 647, doi:10.1016/j.automatica.2010.01.001,
equation 3; for periodic motions of such models, harmonic balance in discrete time.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.newton import newton

_HARMONICS = 7
_ANGLES = 64
_STEPS = 12  # of Newton's method per amplitude
_SOLVED = 1e-9  # largest residual of a converged motion, in units of its amplitude


class StateSpace(NamedTuple):
    """Coefficients of a model; input and output are scaled to unit rms."""

    poles: Float[Array, "mode 2"]  # p and q
    drive: Float[Array, "mode 2"]  # B
    feedthrough: Float[Array, ""]  # D
    nonlinear: Float[Array, "state monomial"]  # E


def hold(angle: Float[np.ndarray, "*angle"]) -> Float[np.ndarray, "*angle"]:
    """sinc²(Ω/2 rate): gain of a sine whose samples are joined by straight lines.

    The linear part of a model is exact for a force that is linear between samples (first-order
    hold); a band-limited force divided by this factor is equivalent to such a force.
    """
    return np.sinc(np.asarray(angle) / (2 * np.pi)) ** 2


Exponents = tuple[tuple[int, ...], ...]


def monomials(states: int, degrees: tuple[int, ...]) -> Exponents:
    """Exponents of all monomials of the given degrees.

    >>> monomials(2, (2,))
    ((2, 0), (1, 1), (0, 2))
    """
    exponents = []
    for degree in degrees:
        for factors in itertools.combinations_with_replacement(range(states), degree):
            exponents.append(tuple(factors.count(k) for k in range(states)))
    return tuple(exponents)


def response(model: StateSpace, z: Complex[Array, " frequency"]) -> Complex[Array, " frequency"]:
    """Frequency response of the linear part at z = e^{iΩ/rate}."""
    (p, q), (b1, b2) = model.poles.T, model.drive.T
    shifted = z[:, None] - p
    return jnp.sum((shifted * b1 + q * b2) / (shifted**2 + q**2), axis=1) + model.feedthrough


def simulated_output(
    model: StateSpace,
    start: Float[Array, " state"],
    force: Float[Array, " sample"],
    exponents: Exponents,
) -> Float[Array, " sample"]:
    """The output, from a given state at the first sample."""

    def step(state: Array, value: Array) -> tuple[Array, Array]:
        output = jnp.sum(state[0::2]) + model.feedthrough * value
        return _next(model, state, value, exponents), output

    return jax.lax.scan(step, start, force, unroll=4)[1]


class Resonances(NamedTuple):
    """Phase resonances of a model by amplitude, in its own units."""

    angle: Float[Array, " amplitude"]  # Ω/rate, rad a sample
    force: Float[Array, " amplitude"]
    residual: Float[Array, " amplitude"]  # over the amplitude; tiny if converged
    slopes: Float[Array, "2 amplitude coefficient"]  # of angle and force over the coefficients


@compiled
def model_resonances(
    model: StateSpace, amplitudes: Float[Array, " amplitude"], exponents: Exponents, mode: int
) -> Resonances:
    """Forced motions whose output is in phase with the force, at rising amplitudes of the output.

    Harmonic balance of the discrete model: with u = F cos θ the states have seven harmonics, F and
    Ω are unknowns, and the output's fundamental is (amplitude) cos θ. Newton's method starts from
    the previous amplitude; derivatives by the implicit function theorem. Coefficients are in the
    order of `ravel_pytree`.
    """
    flat, rebuild = ravel_pytree(model)
    states = 2 * len(model.poles)
    theta = 2 * jnp.pi * jnp.arange(_ANGLES) / _ANGLES
    order = jnp.arange(_HARMONICS + 1)
    waves = jnp.concatenate(
        [jnp.cos(order * theta[:, None]), jnp.sin(order[1:] * theta[:, None])], 1
    )
    project = waves.T * jnp.where(jnp.arange(2 * _HARMONICS + 1) == 0, 1, 2)[:, None] / _ANGLES

    def residual(unknowns: Array, coefficients: Array, amplitude: Array) -> Array:
        """Harmonic balance of the map over an angle of Ω/rate, per unit amplitude."""
        model_at = rebuild(coefficients)
        angle, force = unknowns[0], unknowns[1]
        shapes = unknowns[2:].reshape(states, 2 * _HARMONICS + 1)
        input_force = force * jnp.cos(theta)
        now = amplitude * shapes @ waves.T
        later = jax.vmap(lambda x, u: _next(model_at, x, u, exponents), (1, 0), 1)(
            now, amplitude * input_force
        )
        cosines, sines = shapes[:, 1 : _HARMONICS + 1], shapes[:, _HARMONICS + 1 :]
        c, s = jnp.cos(order[1:] * angle), jnp.sin(order[1:] * angle)
        shifted = jnp.concatenate(
            [shapes[:, :1], cosines * c + sines * s, sines * c - cosines * s], axis=1
        )
        balance = (later @ project.T) / amplitude - shifted
        output = jnp.sum(shapes[0::2], axis=0)
        prescribed = jnp.stack(
            [output[1] + model_at.feedthrough * force - 1.0, output[_HARMONICS + 1]]
        )
        return jnp.concatenate([balance.ravel(), prescribed])

    by_unknowns, by_model = jax.jacfwd(residual), jax.jacfwd(residual, argnums=1)

    def motion(unknowns: Array, amplitude: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        def linearised(point: Array) -> tuple[Array, Array]:
            return residual(point, flat, amplitude), by_unknowns(point, flat, amplitude)

        root = newton(linearised, unknowns, most=_STEPS)
        point, by_coefficients = root.one_more()[0], by_model(root.point, flat, amplitude)
        slopes = -jnp.linalg.solve(root.jacobian, by_coefficients)[:2]
        error = jnp.max(jnp.abs(residual(point, flat, amplitude)))
        return point, (point[:2], slopes, error)

    _, (resonance, slopes, errors) = jax.lax.scan(motion, _linear_motion(model, mode), amplitudes)
    return Resonances(resonance[:, 0], resonance[:, 1], errors, jnp.moveaxis(slopes, 1, 0))


def is_balanced(resonances: Resonances) -> Array:
    """Where the harmonic balance of `model_resonances` has converged."""
    return (resonances.residual < _SOLVED) & (resonances.force > 0)


def modal_constant(model: StateSpace, mode: int) -> Float[Array, ""]:
    """Modal constant a of the mobility a s/(s² + …), times 1/rate."""
    multiplier = jax.lax.complex(*model.poles[mode])
    rate = jnp.log(multiplier)  # of the continuous motion, times 1/rate
    residue = jax.lax.complex(model.drive[mode, 0], -model.drive[mode, 1]) / 2
    residue = residue * (rate / (multiplier - 1)) ** 2  # of a force that is linear between samples
    return jnp.abs(2 * rate.imag * residue / rate)


def _next(model: StateSpace, state: Array, value: Array, exponents: Exponents) -> Array:
    pairs = state.reshape(-1, 2)
    (p, q), (x1, x2) = model.poles.T, pairs.T
    linear = jnp.stack([p * x1 + q * x2, p * x2 - q * x1], axis=1) + model.drive * value
    powers = [
        _powers(state[k], max(degrees[k] for degrees in exponents)) for k in range(len(state))
    ]
    terms = []
    for degrees in exponents:
        product = jnp.ones(())
        for k, power in enumerate(degrees):
            product = product * powers[k][power] if power else product
        terms.append(product)
    return linear.ravel() + model.nonlinear @ jnp.stack(terms)


def _powers(value: Array, most: int) -> list[Array]:
    powers = [jnp.ones(())]
    for _ in range(most):
        powers.append(powers[-1] * value)
    return powers


def _linear_motion(model: StateSpace, mode: int) -> Array:
    """Ω, F and harmonics of the linear model at its phase resonance, amplitude one."""
    multiplier = jax.lax.complex(*model.poles[mode])

    def phase(angle: Array) -> Array:
        return jnp.angle(response(model, jnp.exp(1j * angle)[None])[0])

    angle = jnp.angle(multiplier)
    width = -jnp.log(jnp.abs(multiplier))
    for _ in range(4):  # near resonance tan(phase) = −(angle − resonance)/half the −3 dB bandwidth
        angle = angle + width * jnp.tan(jnp.clip(phase(angle), -1.2, 1.2))
    z = jnp.exp(1j * angle)
    force = 1 / jnp.abs(response(model, z[None])[0])
    (p, q), (b1, b2) = model.poles.T, model.drive.T
    denominator = (z - p) ** 2 + q**2
    states = (
        jnp.stack(
            [((z - p) * b1 + q * b2) / denominator, ((z - p) * b2 - q * b1) / denominator], axis=1
        ).ravel()
        * force
    )
    none = jnp.zeros((len(states), _HARMONICS - 1))
    shapes = jnp.concatenate(
        [jnp.zeros((len(states), 1)), states.real[:, None], none, -states.imag[:, None], none], 1
    )
    return jnp.concatenate([jnp.stack([angle, force]), shapes.ravel()])
