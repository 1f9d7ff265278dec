"""Gains that an answer moves: of the force, of the modal mass, of what the model states."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose.checks.doubts import Doubt
from snrmjax.diagnose.misfit.candidates import parameter_labels
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.identify.checks.instruments import (
    REMEDY_OF_GAIN,
    Determination,
    force_gain_determined,
    force_gain_undetermined,
)
from snrmjax.model.effects import EFFECTS
from snrmjax.model.library.confusions import FORCE_OR_SENSOR_GAIN, SIZE_OF_RESPONSE
from snrmjax.model.modes import UNSTATED_MODAL_MASS_STD

_PULLED = 2.0  # 1σ of a stated parameter, by which an answer may move it without a word
_MOVED_GAIN = 0.05  # of its logarithm, by which a right law moves a gain that smooth curves gave
_FAR_MASS = 3.0  # of 1σ of a modal mass of which none is stated, beyond which it is no reason
_FAR_GAIN = 3.0  # ratio of a gain to the first one, beyond which the answer has moved it away


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
    modes, sensor = misfit.model.modes, misfit.predictions.chosen.sensors[0]
    j = modes.mode_of_interest
    name = f"mode_{j + 1}.participation"
    if name not in misfit.predictions.stated:
        return None
    place = list(misfit.predictions.stated).index(name)
    own, prior = misfit.predictions.stated[name]
    step = float(misfit.noise.shared_errors(fit.rows)[place])
    model = 1 / abs(float(modes.mode_shape[sensor, j]) * own)
    mass = model * own / (own + prior * step)
    relative = prior / abs(own)
    return ModalMassFound(
        mass, mass * relative * misfit.noise.shared_std(fit.slopes, place), model, relative
    )


def notes_on_found_mass(misfit: WeightedMisfit, fit: EffectFit) -> tuple[str, ...]:
    """That the data ask for another modal mass than the model's, inside its stated error."""
    found = modal_mass_found(misfit, fit)
    if found is None or abs(found.value - found.model) <= _PULLED * found.std:
        return ()
    beyond = ""
    if abs(found.value / found.model - 1) > _PULLED * found.stated_std:
        beyond = ", which is farther than that: check the linear test"
    return (
        f"the data say that the modal mass is {found.value:.4g} ± {found.std:.2g} kg; the model "
        f"has {found.model:.4g} kg (1σ stated: {100 * found.stated_std:.2g} %){beyond}. A gain of "
        "the force or of the sensor does the same, so that none of that size can be told from it: "
        "calibrate both statically, or repeat a level with a known added mass.",
    )


def doubts_on_gains(
    misfit: WeightedMisfit, fit: EffectFit, std: Mapping[str, float]
) -> list[Doubt]:
    """Reasons to doubt an answer by what it says of instruments and structure.

    A gain of the force that the data do not determine, or that has moved far from its first value;
    a strength smaller than its own 1σ; and a gain that stands for what an error of the modal mass,
    of which none is stated, could be as well. Arguments: `std` of the effects' parameters by name.
    """
    of_gain = _on_gain(misfit, fit)
    found = [] if of_gain is None else [of_gain]
    return [*found, *_on_strengths(fit, std), *_on_modal_mass(misfit, fit)]


def _on_gain(misfit: WeightedMisfit, fit: EffectFit) -> Doubt | None:
    """Why the gain of an answer is none."""
    gain = gain_found(misfit, fit)
    if gain is None:
        return None
    if not 1 / _FAR_GAIN < gain.value < _FAR_GAIN:
        reason = (
            f"the answer needs {gain.value:.2g} times the force that smooth curves need: with a "
            "force of any size almost any law fits, so the force gain cannot be determined beside "
            "it."
        )
        return Doubt(reason, _remedy(), refutes=True)
    said = force_gain_undetermined(gain.std, gain.farthest)
    if not said and abs(np.log(gain.value)) > _MOVED_GAIN:
        reason = (
            f"the answer moves the force gain by {100 * (gain.value - 1):+.2g} %: smooth curves of "
            "amplitude need the former one, and beside a free gain these data hardly determine the "
            "law."
        )
        return Doubt(reason, _remedy())
    if not said:
        return None
    if force_gain_determined(gain.std) is Determination.NOT_AT_ALL:
        return Doubt(said, _remedy(), refutes=True)
    reason = "the force gain, which these data hardly determine, may be a part of the answer."
    return Doubt(reason, _remedy())


def _remedy() -> str:
    return f"{REMEDY_OF_GAIN[0].lower()}{REMEDY_OF_GAIN[1:]}"


def notes_on_stated_parameters(misfit: WeightedMisfit, fit: EffectFit) -> tuple[str, ...]:
    """Parameters of the model as given that an answer moves beyond their stated errors."""
    moved = misfit.noise.shared_errors(fit.rows)
    pulled = [
        f"`{name}` by {step:+.2g} times its 1σ of {std:.2g}"
        for (name, (_, std)), step in zip(misfit.predictions.stated.items(), moved, strict=False)
        if abs(step) > _PULLED and not name.endswith(".participation")  # said of the modal mass
    ]
    if not pulled:
        return ()
    return (
        f"the answer moves {', '.join(pulled)}, as the model states it: check the linear test, or "
        "whether it was of another assembly.",
    )


def _on_modal_mass(misfit: WeightedMisfit, fit: EffectFit) -> list[Doubt]:
    """That a gain of force or sensor does what a wrong modal mass of the model does.

    Where the model states the mass's error the fit has it, and a gain beyond that is one.
    """
    modes, found = misfit.model.modes, []
    sensor, j = misfit.predictions.chosen.sensors[0], modes.mode_of_interest
    mass = 1 / abs(float(modes.mode_shape[sensor, j] * modes.participation[j]))
    values = dict(zip(fit.labels, fit.values.tolist(), strict=True))
    for kind in fit.kinds if modes.modal_mass_std is None else ():
        if FORCE_OR_SENSOR_GAIN not in EFFECTS[kind].confusions:
            continue
        gain = values[parameter_labels(kind)[0]]
        if abs(np.log1p(gain)) > _FAR_MASS * UNSTATED_MODAL_MASS_STD:
            continue
        found.append(
            Doubt(
                f"{kind} of {gain:+.2g} may be the modal mass: with {mass / (1 + gain):.4g} kg in "
                f"place of the model's {mass:.4g} kg, of which no error is stated "
                "(`modal_mass_std`), the model needs no such effect.",
                SIZE_OF_RESPONSE.separated_by,
            )
        )
    return found


def _on_strengths(fit: EffectFit, std: Mapping[str, float]) -> list[Doubt]:
    """Effects whose strength is smaller than its own 1σ."""
    values, found = dict(zip(fit.labels, fit.values.tolist(), strict=True)), []
    for kind in fit.kinds:
        strength = parameter_labels(kind)[0]
        size, own = abs(values[strength]), std[strength]
        if own > size:
            found.append(
                Doubt(
                    f"these data do not determine {kind}: its strength is {size:.2g} with a 1σ of "
                    f"{own:.2g}, larger than itself.",
                    "measure at more amplitudes and frequencies",
                )
            )
    return found
