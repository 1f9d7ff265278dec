"""Levels whose force is off by a factor of their own, which effects of the structure imitate."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.doubts import Doubt
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.weighted_misfit import FREE_LEVEL_FORCE_STD, WeightedMisfit
from snrmjax.diagnose.search.model_search import AS_GOOD, DETECTED, FoundEffects
from snrmjax.measure.states import SteadyStates


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
        return self.lead > AS_GOOD

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


class _Beside(NamedTuple):
    """A fit beside gains of the forces of levels."""

    criterion: float
    places: tuple[int, ...]  # of the levels
    square: float  # χ²
    kinds: tuple[str, ...]
    n_free: int  # degrees of freedom


def suspected_level_forces(found: FoundEffects, noise: float) -> LevelForces | None:
    """The answer with gains of the forces of fewer than half the levels, where it explains as much.

    Every answer that the search considered is solved once more beside gains, in the linear
    approximation; levels are added while Schwarz's criterion falls by `DETECTED`. None where no
    such answer fits, or where its criterion is behind that of `found` by more than `AS_GOOD`.

    Arguments: `noise` is the variance, over the stated one, that counts as noise.
    Validity: three levels or more, whose phases and forces were measured.
    """
    misfit = found.misfit
    arms = misfit.noise.decorrelated(_of_forces(misfit)).T
    own = found.fit.criterion(misfit.n_rows)
    every = [_beside(misfit, fit, arms) for fit in _distinct(found)]
    tried = [one for one in every if one.places]
    if not tried:
        return None
    best = min(tried, key=lambda one: one.criterion)
    lead, chance = own - best.criterion, chi_square_p_value(best.square / noise, best.n_free)
    if lead < -AS_GOOD or chance < priors.REJECTED:
        return None
    levels = tuple(int(misfit.level_numbers[place]) for place in best.places)
    return LevelForces(best.places, levels, best.kinds, lead)


def level_gains(misfit: WeightedMisfit, fit: EffectFit) -> dict[int, LevelGain]:
    """By level: the acting force over the recorded one, where the misfit leaves it free."""
    places = misfit.predictions.free_level_forces
    if not places:
        return {}
    first = misfit.first_level_force
    gains = {}
    moved = misfit.noise.shared_errors(fit.rows)
    for k, place in enumerate(places):
        value = 1 + FREE_LEVEL_FORCE_STD * float(moved[first + k])
        std = FREE_LEVEL_FORCE_STD * misfit.noise.shared_std(fit.slopes, first + k)
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


def _of_forces(misfit: WeightedMisfit) -> Float[np.ndarray, "level row"]:
    """What a relative error of the force of one level adds to the rows."""
    chosen = misfit.predictions.chosen
    member = np.asarray(chosen.states.level) == np.arange(chosen.n_levels)[:, None]
    return misfit.noise.noise_units(member[:, :, None] * misfit.passed_on.by_error[None, :, :, 0])


def _distinct(found: FoundEffects) -> Iterable[EffectFit]:
    """The best fit of every set of effects that was considered."""
    best: dict[frozenset[str], EffectFit] = {}
    for fit in (found.baseline, found.fit, *found.considered):
        kinds = frozenset(fit.kinds)
        if np.isfinite(fit.chi_square) and (
            kinds not in best or fit.chi_square < best[kinds].chi_square
        ):
            best[kinds] = fit
    return best.values()


def _beside(
    misfit: WeightedMisfit, fit: EffectFit, arms: Float[np.ndarray, "row level"]
) -> _Beside:
    """A fit with gains of those levels that it needs."""
    left = misfit.noise.decorrelated(fit.rows)
    own = misfit.noise.decorrelated(fit.slopes.T).T
    cost = float(np.log(misfit.n_rows))

    def square(places: tuple[int, ...]) -> float:
        columns = np.concatenate([own, arms[:, list(places)]], axis=1)
        if not columns.shape[1]:
            return float(left @ left)
        size = np.linalg.norm(columns, axis=0)
        scaled = columns / np.where(size > 0, size, 1.0)
        steps = np.linalg.lstsq(scaled, left, rcond=1e-10)[0]
        return float(np.sum((left - scaled @ steps) ** 2))

    places: tuple[int, ...] = ()
    least, levels = square(()), range(arms.shape[1])
    while len(places) < (len(levels) - 1) // 2:  # of two that disagree nothing says which is wrong
        others = [(square((*places, k)), (*places, k)) for k in levels if k not in places]
        best, chosen = min(others)
        if least - best - cost <= DETECTED:
            break
        least, places = best, chosen
    n = len(fit.values) + len(places)
    return _Beside(least + n * cost, tuple(sorted(places)), least, fit.kinds, misfit.n_rows - n)
