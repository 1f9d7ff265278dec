"""Whether a damping acts equally in both directions, which only even harmonics show."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.checks.doubts import is_drag
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.model.effect_base import AbstractMemoryless
from snrmjax.model.effects import EFFECTS

_EXCLUDED = 2.0  # 1σ from the even part that a damping of one direction has
_SEEN = 3.0  # 1σ of an even part that is there
_SAMPLES = 256  # of a cycle


def acts_both_ways(misfit: WeightedMisfit, fit: EffectFit, kind: str) -> bool:
    """Whether harmonic 2 excludes that a damping acts in one direction only.

    The force of such a one, such as c|q̇|ⁿ⁻¹q̇, has an even part c|q̇|ⁿ beside it.
    """
    chosen = misfit.predictions.chosen
    if not is_drag(kind) or 2 not in chosen.orders or chosen.phase_unknown.any():
        return False
    share, std = even_share(misfit, fit, kind)
    return abs(share) < _SEEN * std and abs(share) + _EXCLUDED * std < 1


def even_share(misfit: WeightedMisfit, fit: EffectFit, kind: str) -> tuple[float, float]:
    """Ratio of a damping's even part to its odd part by harmonic 2, and its 1σ.

    To first order, (ω₀² − 4Ω² + 4iζω₀Ω) X₂ = −F₂, where F₂ is the second harmonic of the force
    f(|q̇|): c V²/2 for c|q̇|², with the modal velocity V.
    """
    states, modes = misfit.predictions.chosen.states, misfit.predictions.model.modes
    j, sensors = modes.mode_of_interest, misfit.predictions.chosen.sensors
    shape = float(modes.mode_shape[sensors[0], j])
    own, ratio = float(modes.natural_frequency[j]), float(modes.damping_ratio[j])
    omega = np.asarray(states.frequency)
    measured = np.asarray(states.velocity)[:, 0]
    velocity = measured / shape
    force = _second_harmonic(kind, fit.of_kind(kind), np.abs(velocity))
    force = force * (velocity / np.abs(velocity)) ** 2
    answer = -force / (own**2 - 4 * omega**2 + 4j * ratio * own * omega)
    column = 2j * omega * shape * answer / np.abs(measured)
    columns = np.zeros((1, *misfit.noise.known.shape))
    place = 2 * (len(sensors) + misfit.predictions.chosen.orders.index(2))
    columns[0, :, place], columns[0, :, place + 1] = column.real, column.imag
    arm = misfit.noise.decorrelated(misfit.noise.noise_units(columns)[0])
    basis = np.linalg.qr(misfit.noise.decorrelated(fit.slopes.T).T)[0]
    arm = arm - basis @ (basis.T @ arm)
    square = float(arm @ arm)
    if not square > 0:
        return 0.0, np.inf
    left = misfit.noise.decorrelated(fit.rows)
    return -float(arm @ left) / square, 1 / float(np.sqrt(square))


def _second_harmonic(
    kind: str, parameters: tuple[float, ...], speed: Float[np.ndarray, " state"]
) -> Float[np.ndarray, " state"]:
    """Cosine amplitude of harmonic 2 of a drag's force f(|q̇|) over q̇ = V cos β."""
    effect = EFFECTS[kind](*(jnp.asarray(value) for value in parameters))
    if not isinstance(effect, AbstractMemoryless):
        return np.zeros_like(speed)
    phase = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    velocity = jnp.asarray(speed[:, None] * np.abs(np.cos(phase)))
    force = jax.vmap(jax.vmap(effect.force))(jnp.zeros_like(velocity), velocity)
    return 2 * np.mean(np.asarray(force) * np.cos(2 * phase), axis=1)
