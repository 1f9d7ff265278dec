"""Force gain and modal mass as estimated by an answer."""

from collections.abc import Iterator
from typing import NamedTuple

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.numerics.facts import Fact


def fitted_gain(misfit: WeightedMisfit, fit: EffectFit) -> float | None:
    """The free gain, acting over recorded force, of a fit; None where the forces are known."""
    prior, index = misfit.predictions.force_gain_std, len(misfit.predictions.stated)
    return 1 + prior * float(misfit.noise.shared_errors(fit.rows)[index]) if prior else None


class FittedModalMass(NamedTuple):
    """The estimated modal mass in kg, where the model states its error."""

    value: float
    std: float
    model: float
    stated_std: float  # relative


def fitted_modal_mass(misfit: WeightedMisfit, fit: EffectFit) -> FittedModalMass | None:
    """Modal mass 1/(Φ_r Φᵀb) of a fit; None where the model states no error of it."""
    name = f"mode_{misfit.model.modes.mode_of_interest + 1}.participation"
    if name not in misfit.predictions.stated:
        return None
    index = list(misfit.predictions.stated).index(name)
    stated, prior = misfit.predictions.stated[name]
    step, model = float(misfit.noise.shared_errors(fit.rows)[index]), _modal_mass(misfit)
    mass, relative = model * stated / (stated + prior * step), prior / abs(stated)
    std = mass * relative * misfit.noise.shared_std(fit.slopes, index)
    return FittedModalMass(mass, std, model, relative)


def _modal_mass(misfit: WeightedMisfit) -> float:
    """The model's modal mass 1/(Φ_r Φᵀb) at the reference sensor, kg."""
    modes, sensor = misfit.model.modes, misfit.predictions.chosen.sensors[0]
    j = modes.mode_of_interest
    return 1 / abs(float(modes.mode_shape[sensor, j] * modes.participation[j]))


def notes_on_gains(misfit: WeightedMisfit, fit: EffectFit) -> Iterator[Fact]:
    """Stated parameters shifted beyond their errors by an answer, and a deviating modal mass."""
    moved = misfit.noise.shared_errors(fit.rows)
    shifted = tuple(
        (name, float(step), std)
        for (name, (_, std)), step in zip(misfit.predictions.stated.items(), moved, strict=False)
        if abs(step) > priors.SHIFTED
        and not name.endswith(".participation")  # reported as modal mass
    )
    if shifted:
        yield Fact("stated_parameters_moved", parameters=shifted)
    mass = fitted_modal_mass(misfit, fit)
    if mass is not None and abs(mass.value - mass.model) > priors.SHIFTED * mass.std:
        beyond = abs(mass.value / mass.model - 1) > priors.SHIFTED * mass.stated_std
        yield Fact("other_modal_mass", **mass._asdict(), beyond=bool(beyond))
