"""Gains that an answer moves: of the force of single levels, of all forces, of the modal mass."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.doubts import Doubt
from snrmjax.diagnose.misfit.candidates import parameter_labels
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.weighted_misfit import FREE_LEVEL_FORCE_STD, WeightedMisfit
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.identify.checks.instruments import (
    REMEDY_OF_GAIN,
    Determination,
    force_gain_determined,
    force_gain_undetermined,
)
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effects import EFFECTS
from snrmjax.model.library.confusions import FORCE_OR_SENSOR_GAIN, SIZE_OF_RESPONSE
from snrmjax.model.modes import UNSTATED_MODAL_MASS_STD


class LevelGain(NamedTuple):
    """The force that acted at a level over the recorded one."""

    value: float
    std: float  # 1σ

    def __str__(self) -> str:
        """In words, as sentences say it."""
        digits = max(0, 1 - int(np.floor(np.log10(max(self.std, 1e-9)))))
        return f"{self.value:.{digits}f} ± {self.std:.{digits}f}"


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
    def names(self) -> str:
        """The levels in words."""
        listed = " and ".join(str(level) for level in self.levels)
        return f"level{'s' if len(self.levels) > 1 else ''} {listed}"

    @property
    def remedy(self) -> str:
        """What to measure."""
        return (
            f"check the force's range setting and calibration at {self.names}, or measure "
            f"{self.names} again"
        )

    @property
    def doubt(self) -> Doubt:
        """That they explain the data as well."""
        beside = f" beside {' and '.join(self.kinds)}" if self.kinds else ""
        return Doubt(
            f"a force of {self.names} that is recorded in a wrong scale{beside} explains these "
            "data as well.",
            self.remedy,
        )


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
    own, cost = found.fit.criterion(misfit.n_rows), float(np.log(misfit.n_rows))
    fits: dict[frozenset[str], EffectFit] = {}
    for fit in (found.baseline, found.fit, *found.considered):
        known = fits.get(frozenset(fit.kinds))
        if np.isfinite(fit.chi_square) and (known is None or fit.chi_square < known.chi_square):
            fits[frozenset(fit.kinds)] = fit
    best, lead = None, -priors.AS_GOOD_BY_CRITERION
    for fit in fits.values():
        places, square = _beside(misfit, fit, arms)
        n = len(fit.values) + len(places)
        ahead = own - (square + n * cost)
        if places and ahead >= lead:
            levels = tuple(int(misfit.level_numbers[place]) for place in places)
            best, lead = LevelForces(places, levels, fit.kinds, ahead), ahead
            chance = chi_square_p_value(square / noise, misfit.n_rows - n)
    return None if best is None or chance < priors.REJECTED else best


def _beside(
    misfit: WeightedMisfit, fit: EffectFit, arms: Float[np.ndarray, "row level"]
) -> tuple[tuple[int, ...], float]:
    """The levels whose gains a fit needs beside it, and χ² with them."""
    left = misfit.noise.decorrelated(fit.rows)
    own = misfit.noise.decorrelated(fit.slopes.T).T

    def square(places: tuple[int, ...]) -> float:
        columns = np.concatenate([own, arms[:, list(places)]], axis=1)
        size = np.linalg.norm(columns, axis=0)
        scaled = columns / np.where(size > 0, size, 1.0)
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
        value = 1 + FREE_LEVEL_FORCE_STD * float(moved[k])
        std = FREE_LEVEL_FORCE_STD * misfit.noise.shared_std(fit.slopes, k)
        gains[int(misfit.level_numbers[place])] = LevelGain(value, std)
    return gains


def notes_on_level_forces(
    gains: Mapping[int, LevelGain], rival: LevelForces | None, as_recorded: FoundEffects
) -> list[str]:
    """Which effects would stand for the forces of levels, were they taken as recorded."""
    if not gains or rival is None:
        return []
    others = " with ".join(as_recorded.fit.kinds) or "none"
    return [
        f"with the forces as recorded the best answer is {others}, and it fits worse than a gain "
        f"of the force of {rival.names} (Schwarz's criterion: by {rival.lead:.0f})."
    ]


def level_forces_sentence(gains: Mapping[int, LevelGain]) -> str:
    """What a diagnosis says first where the forces of levels were recorded in a wrong scale.

    >>> level_forces_sentence({3: LevelGain(0.9712, 0.0011)})
    'The force at level 3 was 0.9712 ± 0.0011 times the recorded one.'
    """
    return " ".join(
        f"The force at level {level} was {gain} times the recorded one."
        for level, gain in gains.items()
    )


def with_forces_that_acted(data: SteadyStates, gains: Mapping[int, LevelGain]) -> SteadyStates:
    """The states with the forces that acted, where those of some levels were found."""
    if not gains:
        return data
    gain = [gains[k].value if k in gains else 1.0 for k in np.asarray(data.level).tolist()]
    return dataclasses.replace(data, force=data.force * jnp.asarray(gain))


_REMEDY = f"{REMEDY_OF_GAIN[0].lower()}{REMEDY_OF_GAIN[1:]}"


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
    if found is None or abs(found.value - found.model) <= priors.PULLED * found.std:
        return ()
    beyond = ""
    if abs(found.value / found.model - 1) > priors.PULLED * found.stated_std:
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
    of which none is stated, could be as well: where the model states the mass's error the fit has
    it, and a gain beyond that is one. Arguments: `std` of the effects' parameters by name.
    """
    of_gain = _on_gain(misfit, fit)
    found = [] if of_gain is None else [of_gain]
    strengths = {kind: fit.of_kind(kind)[0] for kind in fit.kinds}
    for kind, strength in strengths.items():
        own = std[parameter_labels(kind)[0]]
        if own > abs(strength):
            found.append(
                Doubt(
                    f"these data do not determine {kind}: its strength is {abs(strength):.2g} with "
                    f"a 1σ of {own:.2g}, larger than itself.",
                    "measure at more amplitudes and frequencies",
                )
            )
    modes, sensor = misfit.model.modes, misfit.predictions.chosen.sensors[0]
    j = modes.mode_of_interest
    mass = 1 / abs(float(modes.mode_shape[sensor, j] * modes.participation[j]))
    for kind, gain in strengths.items() if modes.modal_mass_std is None else ():
        far = priors.FAR_MASS * UNSTATED_MODAL_MASS_STD
        if FORCE_OR_SENSOR_GAIN in EFFECTS[kind].confusions and abs(np.log1p(gain)) <= far:
            found.append(
                Doubt(
                    f"{kind} of {gain:+.2g} may be the modal mass: with {mass / (1 + gain):.4g} kg "
                    f"in place of the model's {mass:.4g} kg, of which no error is stated "
                    "(`modal_mass_std`), the model needs no such effect.",
                    SIZE_OF_RESPONSE.separated_by,
                )
            )
    return found


def _on_gain(misfit: WeightedMisfit, fit: EffectFit) -> Doubt | None:
    """Why the gain of an answer is none."""
    gain = gain_found(misfit, fit)
    if gain is None:
        return None
    if not 1 / priors.FAR_GAIN < gain.value < priors.FAR_GAIN:
        reason = (
            f"the answer needs {gain.value:.2g} times the force that smooth curves need: with a "
            "force of any size almost any law fits, so the force gain cannot be determined beside "
            "it."
        )
        return Doubt(reason, _REMEDY, refutes=True)
    said = str(force_gain_undetermined(gain.std, gain.farthest) or "")
    if not said and abs(np.log(gain.value)) > priors.MOVED_GAIN:
        reason = (
            f"the answer moves the force gain by {100 * (gain.value - 1):+.2g} %: smooth curves of "
            "amplitude need the former one, and beside a free gain these data hardly determine the "
            "law."
        )
        return Doubt(reason, _REMEDY)
    if not said:
        return None
    if force_gain_determined(gain.std) is Determination.NOT_AT_ALL:
        return Doubt(said, _REMEDY, refutes=True)
    reason = "the force gain, which these data hardly determine, may be a part of the answer."
    return Doubt(reason, _REMEDY)


def notes_on_stated_parameters(misfit: WeightedMisfit, fit: EffectFit) -> tuple[str, ...]:
    """Parameters of the model as given that an answer moves beyond their stated errors."""
    moved = misfit.noise.shared_errors(fit.rows)
    pulled = [
        f"`{name}` by {step:+.2g} times its 1σ of {std:.2g}"
        for (name, (_, std)), step in zip(misfit.predictions.stated.items(), moved, strict=False)
        if abs(step) > priors.PULLED
        and not name.endswith(".participation")  # said of the modal mass
    ]
    if not pulled:
        return ()
    return (
        f"the answer moves {', '.join(pulled)}, as the model states it: check the linear test, or "
        "whether it was of another assembly.",
    )
