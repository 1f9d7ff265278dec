"""The force and the harmonics that measured motions need by a model with further effects.

The structure has the effects of all candidates with zero strength, so that one compiled program
serves them: a candidate is a vector of parameters.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.diagnose.misfit import programs
from snrmjax.diagnose.misfit.candidates import candidate, motion_scales, parameter_labels
from snrmjax.diagnose.misfit.noise_model import Sizes, sizes_of
from snrmjax.identify.calibrate.calibration_states import (
    CalibrationStates,
    ComparedColumns,
    calibration_states,
    state_whitener,
)
from snrmjax.identify.test_model.priors import FORCE_TO_VELOCITY
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS
from snrmjax.model.parameters import parameter_values, stated_stds
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_blocks, over_cores, padded

_BLOCK = 64  # rows of a program: a state under one vector of parameters each
_ROOM = 256  # states that programs have room for: few tests have more, which compile anew
_DIRECTIONS = 8  # derivatives that a call gives, at most


class Group(NamedTuple):
    """A structure with further effects at zero strength."""

    model: Structure
    names: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    unit: Float[np.ndarray, " parameter"]  # a change that is clearly detectable, or smaller
    is_strength: Bool[np.ndarray, " parameter"]  # the first of an added effect
    is_shape: Bool[np.ndarray, " parameter"]  # another one of it
    force: Int[np.ndarray, " parameter"]  # of the added forces, whose it is; −1: of none

    def places(self, names: Iterable[str]) -> Int[np.ndarray, " name"]:
        """The places of some parameters."""
        return np.array([self.names.index(name) for name in names], dtype=int)

    def at(
        self, names: Sequence[str], values: Float[np.ndarray, "*trial name"]
    ) -> Float[np.ndarray, "*trial parameter"]:
        """All parameters, of which some have other values."""
        whole = np.tile(self.values, (*values.shape[:-1], 1))
        whole[..., self.places(names)] = values
        return whole


class _Steps(NamedTuple):
    """Directions of slopes: a parameter each, or errors of the states where there is none (−1)."""

    place: Int[np.ndarray, " direction"]
    length: Float[np.ndarray, "trial direction"]
    by_error: Float[np.ndarray, "input direction"]


class Predicted(NamedTuple):
    """Columns of all states for several trials, and their derivatives along given directions.

    NaN where no motion was found. A column is the misfit of the force over the measured force, or
    of a harmonic over the measured velocity: real and imaginary parts, or the size and zero where
    the phase is unknown. The phasors are those of the model.
    """

    columns: Float[np.ndarray, "trial state column"]
    slopes: Float[np.ndarray, "trial state column direction"]
    phasors: Complex[np.ndarray, "trial state part"]


@dataclasses.dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of one model for one set of data; `predictions_of` makes them."""

    model: Structure
    given: Structure  # the same, with the errors of levels that were stated
    chosen: ComparedColumns
    sizes: Sizes
    states: CalibrationStates  # with room for harmonics that were not measured
    compared: programs.ComparedMotion
    own_columns: Int[np.ndarray, " column"]  # those of `states` that the data have
    level_numbers: Int[np.ndarray, " state"]
    force_gain_std: float
    stated: dict[str, tuple[float, float]]  # the baseline's uncertain parameters: value and 1σ
    group: Group
    motions: programs.Stored
    added: Float[np.ndarray, "state input"]  # to logarithms of velocities and phases as recorded
    reference: Any = None  # `misfit.reference.Reference`, once it is known
    level_sizes: tuple[float, ...] = (0.0,) * 4  # 1σ of `LEVEL_ERRORS` that the noise takes
    unstated_levels: tuple[bool, ...] = (False,) * 4  # which of them nobody stated
    # What is added to the columns for that: errors that the records were corrected for still count.
    offset: Float[np.ndarray, "state column"] | None = None
    error_scale: float = 1.0  # of errors over those that were stated or assumed

    @property
    def n_baseline_errors(self) -> int:
        """How many shared errors are the baseline's: they come first, then those of levels."""
        return len(self.stated) + (self.force_gain_std > 0)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The effects that candidates may have."""
        added = self.group.model.effects[len(self.model.effects) :]
        return tuple(effect.kind for effect in added)

    def with_kinds(self, kinds: Iterable[str]) -> "Predictions":
        """The same for candidates of some kinds of effects."""
        return dataclasses.replace(self, group=_with_effects(self.model, scales_of(self), kinds))

    def carried_back(self, by_error: Float[np.ndarray, "state column input"]) -> "Predictions":
        """The same as the records have it, by what errors do to the columns."""
        offset = -np.einsum("sci,si->sc", by_error, self.added)
        return dataclasses.replace(self, offset=offset)

    def of_records(
        self,
        data: SteadyStates,
        added: Float[np.ndarray, "state input"],
        harmonics: int | None = None,
    ) -> "Predictions":
        """The same of records to which something was added; it counts once they are weighted.

        Arguments: `data` as they were measured; `harmonics` of the motions, as before if None.
        """
        order = self.compared.harmonic_order if harmonics is None else harmonics
        corrected = with_corrected_records(data, self.chosen.rows, self.chosen.sensors, added)
        records = _records(self.given, corrected, order, self.error_scale)
        return dataclasses.replace(self, **records, added=added)

    def with_errors_scaled(self, factor: float) -> "Predictions":
        """The same with all errors of force, velocities and phases so many times larger."""
        states = self.chosen.states
        scaled = self.chosen._replace(states=states._replace(error=factor * states.error))
        return dataclasses.replace(self, chosen=scaled, error_scale=factor * self.error_scale)

    def with_phases(self, phase: Float[np.ndarray, " state"]) -> "Predictions":
        """The same with velocities of unknown phase at these phases, rad."""
        states, unknown = self.chosen.states, self.chosen.phase_unknown[:, :1]
        turn = np.where(unknown, np.exp(1j * phase)[:, None], 1.0)
        turned = self.chosen._replace(states=states._replace(velocity=states.velocity * turn))
        return dataclasses.replace(self, chosen=turned)

    def whitened_for(
        self,
        by_error: Float[np.ndarray, "state column input"],
        phasors: Complex[np.ndarray, "state part"],
    ) -> tuple[Float[np.ndarray, "state column column"], Bool[np.ndarray, "state column"]]:
        """The whitening of the states by a model with these phasors that passes on errors so.

        And which columns count.
        """
        chosen = self.chosen
        if self.sizes.alone.any():
            std = self.sizes.own_std(np.asarray(chosen.states.own_std), phasors)
            chosen = chosen._replace(states=chosen.states._replace(own_std=jnp.asarray(std)))
        parts = [padded(np.asarray(part), _ROOM) for part in (*chosen.states, by_error)]
        *columns, errors = jax.device_put(parts)
        found = state_whitener(CalibrationStates(*columns), errors, jnp.zeros(()))
        whiten = np.asarray(found)[: len(by_error)]
        used = np.any(whiten != 0, axis=(1, 2))
        return whiten, np.asarray(chosen.states.known) & used[:, None]

    def of(
        self, values: Float[np.ndarray, "trial parameter"], along: Sequence[str] = ()
    ) -> Predicted:
        """The misfit of the states for every trial's parameters, and slopes along some of these."""
        group, places = self.group, self.group.places(along)
        # Slopes are differences, over a small share of a change that is clearly detectable. The
        # unit of a shape may be a guess: its own size counts, unless that is zero.
        size = np.abs(values)
        length = np.maximum(group.unit, np.where(group.is_strength, size, 0.0))
        shape_length = np.clip(size, 1e-6 * group.unit, group.unit)
        length = np.where(group.is_shape & (size > 0), shape_length, length)[:, places]
        steps = _Steps(places, length, np.zeros((self.states.error.shape[1], len(places))))
        columns, slopes = self._in_turn(values, steps)
        slopes = slopes / length[:, None, None]
        if self.offset is not None:
            columns = columns + self.offset
        compared = self.sizes.compared(columns, slopes)
        return Predicted(*compared, self.sizes.phasors(columns))

    def by_error(
        self, values: Float[np.ndarray, " parameter"]
    ) -> tuple[Float[np.ndarray, "state column input"], Complex[np.ndarray, "state part"]]:
        """Derivatives by the states' errors, as a model with these parameters passes them on.

        A gain or a phase acts on what the model has there and not on what was measured, whose noise
        levels of free gain would else explain (D'Agostini, doi:10.1016/0168-9002(94)90719-6).
        Returns the model's phasors too.
        """
        inputs, unit = self.states.error.shape[1], 0.1  # of a logarithm, or rad
        steps = _Steps(np.full(inputs, -1), np.zeros((1, inputs)), unit * np.eye(inputs))
        columns, slopes = self._in_turn(values[None], steps)
        slopes = slopes / unit - self._by_error_of_missed(columns)
        found = self.sizes.compared(columns, slopes, of_errors=True)[1]
        return found[0], self.sizes.phasors(columns)[0]

    def _by_error_of_missed(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Float[np.ndarray, "trial state column input"]:
        """What gains and phases do to the difference of the model from other sensors and harmonics.

        Both act on a sensor's motion; a phase turns harmonic h by h times as much.
        """
        orders, n = self.chosen.orders, len(self.chosen.sensors)
        sensor = [*range(1, n), *np.repeat(np.arange(n), len(orders))]
        order = [*[1] * (n - 1), *orders * n]
        found = np.zeros((*columns.shape, 1 + 2 * n))
        for k, (s, h) in enumerate(zip(sensor, order, strict=True), 1):
            missed = columns[..., 2 * k] + 1j * columns[..., 2 * k + 1]
            for place, by in ((1 + s, missed), (1 + n + s, 1j * h * missed)):
                found[..., 2 * k, place], found[..., 2 * k + 1, place] = by.real, by.imag
        return found

    def _in_turn(
        self, values: Float[np.ndarray, "trial parameter"], steps: "_Steps"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns, and slopes along some directions after the other."""
        wanted, parts = len(steps.place), []
        for begin in range(0, max(wanted, 1), _DIRECTIONS):
            some = [a[..., begin : begin + _DIRECTIONS] for a in steps]
            room = [(0, _DIRECTIONS - some[0].size)]
            filled = _Steps(*(np.pad(a, [(0, 0)] * (a.ndim - 1) + room) for a in some))
            parts.append(self._answers(values, filled, min(wanted - begin, _DIRECTIONS)))
        return parts[0][0], np.concatenate([slope for _, slope in parts], axis=3)[..., :wanted]

    def _answers(
        self, values: Float[np.ndarray, "trial parameter"], steps: "_Steps", wanted: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and slopes: friction by quick formulas, over the whole cycle where they fail."""
        group = self.group
        used = np.any(values != group.values, axis=0)
        used[steps.place[:wanted][steps.place[:wanted] >= 0]] = True
        active = np.zeros(group.force.max() + 1, dtype=bool)
        active[group.force[used & (group.force >= 0)]] = True
        n, trials = len(self.chosen.rows), len(values)
        state, trial = np.tile(np.arange(n), trials), np.repeat(np.arange(trials), n)

        def answered(quick: bool, rows: np.ndarray) -> tuple[np.ndarray, ...]:
            def block(some: np.ndarray) -> list[np.ndarray]:
                at = padded(some, _BLOCK)
                first = int(trial[some[0]])
                near = slice(first, first + _BLOCK)  # no more trials meet in a block
                ours = [padded(a[near], _BLOCK) for a in (values, steps.length)]
                asked: list[Any] = [*ours, steps.place, steps.by_error, active, np.array(wanted)]
                asked += [state[at], trial[at] - first]
                how = programs.Settings(group.names, self.compared, len(self.model.effects), quick)
                found = programs.missed(group.model, how, self.motions, programs.Asked(*asked))
                return [np.asarray(a)[: len(some), self.own_columns] for a in found]

            blocks = np.split(rows, range(_BLOCK, len(rows), _BLOCK))
            parts = over_cores(block, blocks)
            return tuple(np.concatenate(column) for column in zip(*parts, strict=True))

        found = answered(True, np.arange(n * trials))
        good = [np.isfinite(part).reshape(len(part), -1).all(axis=1) for part in found]
        left = np.flatnonzero(~(good[0] & good[1]))
        if left.size and any(_has_quick_formula(group.names[k]) for k in np.flatnonzero(used)):
            for part, own in zip(found, answered(False, left), strict=True):
                part[left] = own
        columns, slopes = (a.reshape(trials, n, *a.shape[1:]) for a in found)
        return columns, slopes


def predictions_of(
    model: Structure,
    data: SteadyStates,
    force_gain_std: float = 0.0,
    *,
    harmonics: int = programs.HARMONICS,
    kinds: Iterable[str] | None = None,
) -> Predictions:
    """Predictions of a model for measured states, ready to be evaluated.

    The baseline's motions are found here. `force_gain_std` is the relative 1σ of a gain that all
    forces share; `harmonics` are those of the motions; `kinds` the effects that candidates may
    have, all that are known if None: their programs are the larger, the more they are.
    """
    model = dataclasses.replace(model, name="")  # its name would be a part of the programs
    records = _records(model, data, harmonics)
    numbers = parameter_values(model)
    return Predictions(
        model=model,
        given=model,
        **records,
        added=np.zeros_like(records["chosen"].states.error),
        level_numbers=np.asarray(data.level)[records["chosen"].rows],
        force_gain_std=force_gain_std,
        stated={
            name: (numbers[name], std)
            for name, std in (stated_stds(model) | _of_modal_mass(model, force_gain_std)).items()
        },
        group=_with_effects(
            model, motion_scales(model, records["chosen"]), EFFECTS if kinds is None else kinds
        ),
    )


def _records(
    model: Structure, data: SteadyStates, harmonics: int, error_scale: float = 1.0
) -> dict[str, Any]:
    """What of `Predictions` depends on the records, with the baseline's motions at them."""
    chosen = calibration_states(model, data, programs.HARMONICS)
    # Operations of JAX compile for every number of states.
    on_host: Any = jax.tree.map(np.asarray, chosen.states)
    error = on_host.error
    # A force errs by a share of the velocity's error where none is stated: beside a steep curve an
    # error of amplitude shows itself in the frequency, and the damping would be exact.
    force = np.where(error[:, :1] > 0, error[:, :1], FORCE_TO_VELOCITY * error[:, 1:2])
    error = error_scale * np.concatenate([force, error[:, 1:]], axis=1)
    chosen = chosen._replace(states=on_host._replace(error=error))
    columns, orders, own_columns = _widened(chosen)
    compared = programs.ComparedMotion(chosen.sensors, orders, harmonics)

    def motions(*rows: Array) -> tuple[Array, Array]:
        return programs.grown(model, CalibrationStates(*rows), compared)

    found = by_blocks(motions, 16, *columns)  # grown one after the other
    arrays = jax.device_put([padded(rows, _ROOM) for rows in (*columns, *found)])
    every: list[Any] = columns
    return {
        "chosen": chosen,
        "sizes": sizes_of(chosen),
        "states": CalibrationStates(*every),
        "compared": compared,
        "own_columns": own_columns,
        "motions": programs.Stored(CalibrationStates(*arrays[:-2]), *arrays[-2:]),
    }


def _of_modal_mass(model: Structure, force_gain_std: float) -> dict[str, float]:
    """1σ of the participation by the stated one of the modal mass 1/(Φ_r Φᵀb).

    Beside a gain of all forces that is free the modal mass is one with it, and so the model's.
    """
    modes, j = model.modes, model.modes.mode_of_interest
    if modes.modal_mass_std is None or force_gain_std > 0:
        return {}
    std = abs(modes.participation.item(j)) * modes.modal_mass_std.item(j)
    return {f"mode_{j + 1}.participation": std} if std > 0 else {}


def _with_effects(baseline: Structure, scales: MotionScales, kinds: Iterable[str]) -> Group:
    """The structure with some kinds of effects that the baseline does not have."""
    present = [effect.kind for effect in baseline.effects]
    model = with_idle_effects(baseline, [kind for kind in kinds if kind not in present])
    added = model.effects[len(present) :]
    numbers, stds = parameter_values(model), stated_stds(model)
    names, values = tuple(numbers), np.array(list(numbers.values()))
    kinds = [added[k].kind for k in programs.forces_of(added)]
    owner = [name.split(".")[0] for name in names]
    force = np.array([kinds.index(o) if o in kinds else -1 for o in owner])
    std = np.array([stds.get(name, 0.0) for name in names])
    unit = np.maximum(0.01 * np.abs(values), std)
    unit[unit == 0] = 1.0
    where = {name: k for k, name in enumerate(names)}
    is_strength, is_shape = np.zeros((2, len(names)), dtype=bool)
    for effect in added:
        places = [where[label] for label in parameter_labels(effect.kind)]
        unit[places] = candidate(effect.kind, scales).unit
        is_strength[places[0]], is_shape[places[1:]] = True, True
    return Group(model, names, values, unit, is_strength, is_shape, force)


def with_idle_effects(model: Structure, kinds: Sequence[str]) -> Structure:
    """The model with further effects that have no strength: the same physics."""
    modes, j = model.modes, model.modes.mode_of_interest
    mode = modes.natural_frequency.item(j), modes.damping_ratio.item(j)
    added = tuple(EFFECTS[kind].without_strength(*mode) for kind in kinds)
    return dataclasses.replace(model, effects=(*model.effects, *added))


def _has_quick_formula(name: str) -> bool:
    """Whether a parameter is one of an effect that has a quick formula."""
    effect = EFFECTS.get(name.split(".")[0])
    return effect is not None and issubclass(effect, AbstractForce) and effect.has_quick_formula()


def _widened(chosen: ComparedColumns) -> tuple[list[np.ndarray], tuple[int, ...], np.ndarray]:
    """The states as the programs take them, their harmonics, and which columns are the states' own.

    Harmonics that the states lack have room: the states of a further test have them, and one
    program answers for both.
    """
    n, n_sensors = chosen.states.velocity.shape
    orders = tuple(sorted({*programs.COMPARED, *chosen.orders}))
    places = np.array([orders.index(h) for h in chosen.orders], dtype=int)
    harmonics = np.zeros((n, n_sensors, len(orders)), dtype=complex)
    harmonics[:, :, places] = chosen.states.harmonics
    first = n_sensors + len(orders) * np.arange(n_sensors)[:, None]
    phasors = np.append(np.arange(n_sensors), first + places)
    columns = (2 * phasors[:, None] + np.arange(2)).reshape(-1)
    wide = np.zeros((2, n, 2 * n_sensors * (1 + len(orders))))
    # Of a phasor whose size alone counts the programs give both parts.
    known = np.asarray(chosen.states.known)[:, ::2]
    wide[:, :, columns] = chosen.states.own_std, np.repeat(known, 2, axis=1)
    widened = {"harmonics": harmonics, "own_std": wide[0], "known": wide[1] > 0}
    parts = [np.asarray(a) for a in (chosen.states._asdict() | widened).values()]
    return parts, orders, columns


def scales_of(predictions: Predictions) -> MotionScales:
    """Typical sizes of the measured motions."""
    return motion_scales(predictions.model, predictions.chosen)


def with_corrected_records(
    data: SteadyStates,
    rows: Int[np.ndarray, " state"],
    sensors: tuple[int, ...],
    added: Float[np.ndarray, "state input"],
) -> SteadyStates:
    """The data with errors of velocities and phases taken away, of the states in `rows`."""
    plain: Any = jax.tree.map(np.asarray, data)
    n = len(sensors)
    size, turn = np.ones((data.n_states, n)), np.zeros((data.n_states, n))
    size[rows], turn[rows] = np.exp(added[:, 1 : n + 1]), added[:, n + 1 :]
    back = np.argsort(sensors)
    size, turn = size[:, back], turn[:, back]
    orders = np.array(data.harmonic_order, dtype=int)
    found: SteadyStates = dataclasses.replace(
        plain,
        velocity=plain.velocity * (size * np.exp(1j * turn)),
        velocity_std=plain.velocity_std * size,
        harmonics=plain.harmonics * size[:, :, None] * np.exp(1j * turn[:, :, None] * orders),
        harmonic_std=plain.harmonic_std * size,
    )
    return found
