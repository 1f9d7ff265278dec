"""Naming for a test and a model: the mode's readings beyond the model, and what explains them."""

from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.diagnose.decide import Verdict
from snrmjax.diagnose.misfit.predictions import Predictions, scales_of
from snrmjax.diagnose.misfit.reference import test_states_of
from snrmjax.diagnose.naming.columns import is_instrument
from snrmjax.diagnose.naming.evidence import Problem, best_hypotheses
from snrmjax.diagnose.naming.parts import Naming, naming_of
from snrmjax.diagnose.naming.readings import LinearTest, ModelStiffness, Readings, readings_of
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.identify.pointwise.snrm import linear_mode, participation_of, sensed_mode
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import AbstractAddedMode
from snrmjax.model.effects import EFFECTS
from snrmjax.model.modes import residual_velocity
from snrmjax.model.parameters import with_parameters

_FEWEST = 6  # states with a phase


class NamedParts(NamedTuple):
    """A naming, and the problem that it is of."""

    naming: Naming
    problem: Problem


def named_parts(
    predictions: Predictions, data: SteadyStates, kinds: Iterable[str]
) -> NamedParts | None:
    """What explains most of the change of stiffness and damping; None where phases are unknown.

    Arguments: `data` as they were measured; `kinds` of effects that may be missing.
    """
    rows = np.flatnonzero(~predictions.chosen.phase_unknown[:, 0])
    if len(rows) < _FEWEST:
        return None
    if not predictions.chosen.orders:  # only its harmonics tell a further mode from a softening law
        kinds = [k for k in kinds if not issubclass(EFFECTS[k], AbstractAddedMode)]
    readings = _readings(predictions, data, rows)
    if predictions.given.modes.modal_mass_std is None:  # the mass that nobody stated is the gain
        kinds = [kind for kind in kinds if not _is_gain(kind)]
    problem, cells = best_hypotheses(readings, kinds)
    return NamedParts(naming_of(problem, cells), problem)


def _is_gain(kind: str) -> bool:
    """Whether a kind is a gain of the instruments, as another modal mass is."""
    return EFFECTS[kind].like_force_gain and is_instrument(kind)


def overall(naming: Naming) -> Verdict:
    """The verdict on all parts: the weakest of those that change by more than noise."""
    verdicts = [Verdict(part.verdict) for part in naming.parts]
    order = (Verdict.DRAWN, Verdict.AMBIGUOUS, Verdict.NAMED)
    return next((one for one in order if one in verdicts), Verdict.NOTHING_MISSING)


def _readings(predictions: Predictions, data: SteadyStates, rows: np.ndarray) -> Readings:
    states, modes = test_states_of(predictions, rows), predictions.given.modes
    j = modes.mode_of_interest
    order = np.asarray(data.order)[predictions.chosen.rows[rows]]
    order = np.where(np.isfinite(order), order, np.linspace(0.0, 1.0, len(rows)))
    natural, ratio = map(float, linear_mode(modes))
    linear = LinearTest(
        natural,
        ratio,
        modes.natural_frequency_std.item(j),
        modes.damping_ratio_std.item(j),
        states.mass_std,
        modes.mode_shape.item(predictions.chosen.sensors[0], j),
        scales_of(predictions),
    )
    return readings_of(states, order, _model_stiffness(predictions, data, rows), linear)


def _model_stiffness(
    predictions: Predictions, data: SteadyStates, rows: np.ndarray
) -> ModelStiffness:
    """The dynamic stiffness that the model has: of a linear mode as written, else by balance."""
    model = predictions.given
    modes, sensor = model.modes, predictions.chosen.sensors[0]
    j = modes.mode_of_interest
    natural, ratio = map(float, linear_mode(modes))
    if not (model.effects or model.potential.monomials):
        return lambda _, omega: (natural**2 - omega**2 + 2j * ratio * natural * omega)[None]
    constant = modes.mode_shape.item(sensor, j) * float(participation_of(modes))
    used = predictions.chosen.rows[rows]
    uncertain = [
        with_parameters(model, (name,), jnp.asarray([value + std]))
        for name, (value, std) in predictions.stated.items()
        if not name.startswith("mode_")  # linear parameters have columns of their own
    ]

    def balanced(
        velocity: Complex[np.ndarray, " state"], omega: Float[np.ndarray, " state"]
    ) -> Complex[np.ndarray, " state"]:
        sensed = sensed_mode(modes, omega)
        to_mode, driven = np.asarray(sensed.to_mode(sensor)), constant * np.asarray(sensed.ratio)
        own = np.sign(constant) * velocity / to_mode
        force = jnp.asarray(np.asarray(data.force)[used])
        rest = np.asarray(residual_velocity(modes, jnp.asarray(omega), jnp.ones_like(force)))
        recorded = np.asarray(data.velocity).copy()
        recorded[used, sensor] = own + rest[:, sensor] * np.asarray(force)
        moved = eqx.tree_at(lambda d: d.velocity, data, jnp.asarray(recorded))
        found = []
        for one in (model, *uncertain):
            needed = np.asarray(inverse_force(one, moved).force)[used]
            # The rest of the motion at the force that the model needs, and not the measured one.
            mode = own + rest[:, sensor] * (np.asarray(force) - needed)
            found.append(1j * omega * driven * needed / (mode * to_mode))
        return np.array(found)

    return balanced
