"""What an answer says of gains of the force and of the modal mass."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.numerics.facts import Fact


class GainFound(NamedTuple):
    """The acting force over the recorded one, where a gain is free."""

    value: float
    std: float  # relative 1σ, beside all parameters of the answer
    farthest: float  # rad, the largest phase of a state from resonance


def gain_found(misfit: WeightedMisfit, fit: EffectFit) -> GainFound | None:
    """The gain as an answer has it; None where the forces are known."""
    prior, place = misfit.predictions.force_gain_std, len(misfit.predictions.stated)
    if prior == 0:
        return None
    value = 1 + prior * float(misfit.noise.shared_errors(fit.rows)[place])
    std = prior * misfit.noise.shared_std(fit.slopes, place)
    phase = np.angle(np.asarray(misfit.predictions.chosen.states.velocity)[:, 0])
    known_phase = ~misfit.predictions.chosen.phase_unknown[:, 0]
    farthest = float(np.max(np.abs(phase[known_phase]), initial=0.0))
    return GainFound(value, std / max(abs(value), 1e-12), farthest)


class ModalMassFound(NamedTuple):
    """The modal mass that an answer leaves, where the model states its error, in kg."""

    value: float
    std: float
    model: float
    stated_std: float  # relative


def modal_mass_found(misfit: WeightedMisfit, fit: EffectFit) -> ModalMassFound | None:
    """The modal mass as seen from force and sensor; None where the model states no error of it."""
    name = f"mode_{misfit.model.modes.mode_of_interest + 1}.participation"
    if name not in misfit.predictions.stated:
        return None
    place = list(misfit.predictions.stated).index(name)
    stated, prior = misfit.predictions.stated[name]
    step, model = float(misfit.noise.shared_errors(fit.rows)[place]), _modal_mass(misfit)
    mass, relative = model * stated / (stated + prior * step), prior / abs(stated)
    std = mass * relative * misfit.noise.shared_std(fit.slopes, place)
    return ModalMassFound(mass, std, model, relative)


def _modal_mass(misfit: WeightedMisfit) -> float:
    """The model's, as seen from force and reference sensor, kg."""
    modes, sensor = misfit.model.modes, misfit.predictions.chosen.sensors[0]
    j = modes.mode_of_interest
    return 1 / abs(float(modes.mode_shape[sensor, j] * modes.participation[j]))


def notes_on_gains(misfit: WeightedMisfit, fit: EffectFit) -> Iterator[Fact]:
    """Stated parameters that an answer moves beyond their errors, and another modal mass."""
    moved = misfit.noise.shared_errors(fit.rows)
    pulled = tuple(
        (name, float(step), std)
        for (name, (_, std)), step in zip(misfit.predictions.stated.items(), moved, strict=False)
        if abs(step) > priors.PULLED
        and not name.endswith(".participation")  # said of the modal mass
    )
    if pulled:
        yield Fact("stated_parameters_moved", parameters=pulled)
    mass = modal_mass_found(misfit, fit)
    if mass is not None and abs(mass.value - mass.model) > priors.PULLED * mass.std:
        beyond = abs(mass.value / mass.model - 1) > priors.PULLED * mass.stated_std
        yield Fact("other_modal_mass", **mass._asdict(), beyond=bool(beyond))
