"""Gains that an answer moves: of the force of single levels, of all forces, of the modal mass."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.alternative_laws import Doubt
from snrmjax.diagnose.misfit.candidates import parameter_labels
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value, unit_columns
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.identify.checks.instruments import (
    Determination,
    force_gain_determined,
    force_gain_undetermined,
)
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effects import EFFECTS
from snrmjax.model.library.confusions import FORCE_OR_SENSOR_GAIN, SIZE_OF_RESPONSE
from snrmjax.model.modes import UNSTATED_MODAL_MASS_STD
from snrmjax.numerics.facts import Fact

_CALIBRATE = Fact("determine_force_gain")


class LevelGain(NamedTuple):
    """The force that acted at a level over the recorded one."""

    value: float
    std: float  # 1σ


class LevelForces(NamedTuple):
    """An answer in which the forces of some levels have gains of their own."""

    places: tuple[int, ...]  # of the levels, in the order of their numbers
    levels: tuple[int, ...]  # their numbers
    kinds: tuple[str, ...]  # effects beside the gains
    lead: float  # of its criterion over that of the answer without them

    @property
    def is_better(self) -> bool:
        """Whether the data prefer it clearly."""
        return self.lead > priors.AS_GOOD_BY_CRITERION

    @property
    def doubt(self) -> Doubt:
        """That they explain the data as well."""
        reason = Fact("level_forces_alike", levels=self.levels, effects=self.kinds)
        return Doubt(reason, Fact("check_level_forces", levels=self.levels))


def suspected_level_forces(found: FoundEffects, noise: float) -> LevelForces | None:
    """The answer with gains of the forces of fewer than half the levels, where it explains as much.

    Every answer that the search considered is solved once more beside gains, in the linear
    approximation; levels are added while Schwarz's criterion falls by `DETECTED`. None where no
    such answer fits, or where its criterion is behind that of `found` by more than
    `AS_GOOD_BY_CRITERION`.

    Arguments: `noise` is the variance, over the stated one, that counts as noise.
    Validity: three levels or more, whose phases and forces were measured.
    """
    misfit, chosen = found.misfit, found.misfit.predictions.chosen
    member = np.asarray(chosen.states.level) == np.arange(chosen.n_levels)[:, None]
    of_forces = member[:, :, None] * misfit.passed_on.by_error[None, :, :, 0]
    arms = misfit.noise.decorrelated(misfit.noise.noise_units(of_forces)).T
    as_recorded, cost = found.fit.criterion, float(np.log(misfit.n_rows))
    fits: dict[frozenset[str], EffectFit] = {}
    for fit in (found.baseline, found.fit, *found.considered):
        known = fits.get(frozenset(fit.kinds))
        if np.isfinite(fit.chi_square) and (known is None or fit.chi_square < known.chi_square):
            fits[frozenset(fit.kinds)] = fit
    best, lead, chance = None, -priors.AS_GOOD_BY_CRITERION, 0.0
    for fit in fits.values():
        places, square = _beside(misfit, fit, arms)
        n = len(fit.values) + len(places)
        ahead = as_recorded - (square + n * cost)
        if places and ahead >= lead:
            levels = tuple(int(misfit.level_numbers[place]) for place in places)
            best, lead = LevelForces(places, levels, fit.kinds, ahead), ahead
            chance = chi_square_p_value(square / noise, misfit.n_rows - n)
    return None if chance < priors.REJECTED else best


def _beside(
    misfit: WeightedMisfit, fit: EffectFit, arms: Float[np.ndarray, "row level"]
) -> tuple[tuple[int, ...], float]:
    """The levels whose gains a fit needs beside it, and χ² with them."""
    left = misfit.noise.decorrelated(fit.rows)
    by_parameter = misfit.noise.decorrelated(fit.slopes.T).T

    def square(places: tuple[int, ...]) -> float:
        columns = np.concatenate([by_parameter, arms[:, list(places)]], axis=1)
        scaled, _ = unit_columns(columns)
        steps = np.linalg.lstsq(scaled, left, rcond=1e-10)[0]
        return float(np.sum((left - scaled @ steps) ** 2))

    places: tuple[int, ...] = ()
    least, levels = square(()), range(arms.shape[1])
    while len(places) < (len(levels) - 1) // 2:  # of two that disagree nothing says which is wrong
        others = [(square((*places, k)), (*places, k)) for k in levels if k not in places]
        best, chosen = min(others)
        if least - best - np.log(misfit.n_rows) <= priors.DETECTED:
            break
        least, places = best, chosen
    return tuple(sorted(places)), least


def level_gains(misfit: WeightedMisfit, fit: EffectFit) -> dict[int, LevelGain]:
    """By level: the acting force over the recorded one, where the misfit leaves it free."""
    predictions, gains = misfit.predictions, {}
    # Among the shared errors they come after the baseline's and a gain of all forces.
    first = predictions.n_baseline_errors
    moved = misfit.noise.shared_errors(fit.rows)
    for k, place in enumerate(predictions.free_level_forces, first):
        value = 1 + priors.FREE_LEVEL_FORCE_STD * float(moved[k])
        std = priors.FREE_LEVEL_FORCE_STD * misfit.noise.shared_std(fit.slopes, k)
        gains[int(misfit.level_numbers[place])] = LevelGain(value, std)
    return gains


def with_forces_that_acted(data: SteadyStates, gains: Mapping[int, LevelGain]) -> SteadyStates:
    """The states with the forces that acted, where those of some levels were found."""
    if not gains:
        return data
    gain = [gains[k].value if k in gains else 1.0 for k in np.asarray(data.level).tolist()]
    return dataclasses.replace(data, force=data.force * jnp.asarray(gain))


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


def doubts_on_gains(
    misfit: WeightedMisfit, fit: EffectFit, std: Mapping[str, float]
) -> list[Doubt]:
    """Reasons to doubt an answer by what it says of instruments and structure.

    A gain of the force that the data do not determine, or that has moved far from its first value;
    a strength smaller than its own 1σ; and a gain that stands for what an error of the modal mass,
    of which none is stated, could be as well: where the model states the mass's error the fit has
    it, and a gain beyond that is one. Arguments: `std` of the effects' parameters by name.
    """
    of_gain = _on_gain(misfit, fit)
    found = [] if of_gain is None else [of_gain]
    strengths = {kind: fit.of_kind(kind)[0] for kind in fit.kinds}
    for kind, strength in strengths.items():
        error = std[parameter_labels(kind)[0]]
        if error > abs(strength):
            reason = Fact("strength_unknown", effect=kind, strength=abs(strength), std=error)
            found.append(Doubt(reason, Fact("measure_more")))
    mass, far = _modal_mass(misfit), priors.FAR_MASS * UNSTATED_MODAL_MASS_STD
    for kind, gain in strengths.items() if misfit.model.modes.modal_mass_std is None else ():
        if FORCE_OR_SENSOR_GAIN in EFFECTS[kind].confusions and abs(np.log1p(gain)) <= far:
            masses = {"mass": mass / (1 + gain), "mass_of_model": mass}
            reason = Fact("gain_or_modal_mass", effect=kind, gain=gain, **masses)
            found.append(Doubt(reason, SIZE_OF_RESPONSE.separated_by))
    return found


def _on_gain(misfit: WeightedMisfit, fit: EffectFit) -> Doubt | None:
    """Why the gain of an answer is none."""
    gain = gain_found(misfit, fit)
    if gain is None:
        return None
    if not 1 / priors.FAR_GAIN < gain.value < priors.FAR_GAIN:
        return Doubt(Fact("force_gain_far", gain=gain.value), _CALIBRATE, refutes=True)
    undetermined = force_gain_undetermined(gain.std, gain.farthest)
    if undetermined:
        if force_gain_determined(gain.std) is Determination.NOT_AT_ALL:
            return Doubt(undetermined, _CALIBRATE, refutes=True)
        return Doubt(Fact("force_gain_in_answer"), _CALIBRATE)
    if abs(np.log(gain.value)) > priors.MOVED_GAIN:
        return Doubt(Fact("force_gain_moved", change=gain.value - 1), _CALIBRATE)
    return None
