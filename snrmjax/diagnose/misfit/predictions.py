"""Force and harmonics for the measured motions, by a model with further effects.

The structure has the effects of all candidates at zero strength, so that one compiled program
serves all of them: a candidate is a vector of parameters.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.diagnose.kinds.registry import without_strength
from snrmjax.diagnose.misfit import programs
from snrmjax.diagnose.misfit.candidates import candidate, motion_scales, parameter_labels
from snrmjax.diagnose.misfit.noise_model import Magnitudes, magnitudes_of
from snrmjax.identify.calibrate.calibration_states import (
    CalibrationStates,
    ComparedColumns,
    calibration_states,
    state_whitener,
)
from snrmjax.identify.test_model.priors import FORCE_TO_VELOCITY
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS
from snrmjax.model.parameters import parameter_values, stated_stds
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_blocks, over_cores, padded

_BLOCK = 64  # rows of a program: a state with one vector of parameters each
_ROOM = 256  # padded number of states; larger tests recompile
_DIRECTIONS = 8  # most derivatives a call


class Group(NamedTuple):
    """A structure with further effects at zero strength."""

    model: Structure
    names: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    unit: Float[np.ndarray, " parameter"]  # a clearly detectable change, or smaller
    is_strength: Bool[np.ndarray, " parameter"]  # first parameter of an added effect
    is_shape: Bool[np.ndarray, " parameter"]  # its other parameters
    force: Int[np.ndarray, " parameter"]  # index of the added force of this parameter; −1: none

    def indices(self, names: Iterable[str]) -> Int[np.ndarray, " name"]:
        """Indices of some parameters."""
        return np.array([self.names.index(name) for name in names], dtype=int)

    def at(
        self, names: Sequence[str], values: Float[np.ndarray, "*trial name"]
    ) -> Float[np.ndarray, "*trial parameter"]:
        """All parameters, with new values of some."""
        whole = np.tile(self.values, (*values.shape[:-1], 1))
        whole[..., self.indices(names)] = values
        return whole


class _Steps(NamedTuple):
    """Directions of derivatives: a parameter each, or errors of the states (index −1)."""

    parameter: Int[np.ndarray, " direction"]
    length: Float[np.ndarray, "trial direction"]
    by_error: Float[np.ndarray, "input direction"]


class Predicted(NamedTuple):
    """Columns of all states for several trials, and their derivatives along given directions.

    NaN without convergence. A column is the misfit of the force over the measured force, or of a
    harmonic over the measured velocity: real and imaginary parts, or the magnitude and zero where
    the phase is unknown. The phasors are the model's.
    """

    columns: Float[np.ndarray, "trial state column"]
    slopes: Float[np.ndarray, "trial state column direction"]
    phasors: Complex[np.ndarray, "trial state part"]


@dataclasses.dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of one model for one set of data; `predictions_of` makes them."""

    model: Structure
    given: Structure  # the same, with the level errors as stated
    chosen: ComparedColumns
    magnitudes: Magnitudes
    states: CalibrationStates  # padded with harmonics that were not measured
    compared: programs.ComparedMotion
    own_columns: Int[np.ndarray, " column"]  # measured columns of `states`
    level_numbers: Int[np.ndarray, " state"]
    force_gain_std: float
    stated: dict[str, tuple[float, float]]  # the baseline's uncertain parameters: value and 1σ
    group: Group
    motions: programs.Stored
    added: Float[np.ndarray, "state input"]  # corrections to recorded log velocities and phases
    reference: Any = None  # `misfit.reference.Reference`, once known
    level_error_std: tuple[float, ...] = (0.0,) * 4  # estimated 1σ of `LEVEL_ERRORS`
    unstated_levels: tuple[bool, ...] = (False,) * 4  # which of them were not stated
    # Change of the columns back to the uncorrected records: corrected errors still count.
    offset: Float[np.ndarray, "state column"] | None = None
    error_scale: float = 1.0  # of errors over the stated or assumed ones

    @property
    def n_baseline_errors(self) -> int:
        """Number of shared errors of the baseline: they come first, then those of levels."""
        return len(self.stated) + (self.force_gain_std > 0)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The effects available to candidates."""
        added = self.group.model.effects[len(self.model.effects) :]
        return tuple(effect.kind for effect in added)

    def with_kinds(self, kinds: Iterable[str]) -> "Predictions":
        """The predictions for candidates of some kinds of effects."""
        return dataclasses.replace(self, group=_with_effects(self.model, scales_of(self), kinds))

    def referred_to_records(
        self, by_error: Float[np.ndarray, "state column input"]
    ) -> "Predictions":
        """The predictions referred to the uncorrected records, by first-order error propagation."""
        offset = -np.einsum("sci,si->sc", by_error, self.added)
        return dataclasses.replace(self, offset=offset)

    def of_records(
        self, data: SteadyStates, added: Float[np.ndarray, "state input"]
    ) -> "Predictions":
        """The predictions at records with `added` corrections; the offset follows with weighting.

        Arguments: `data`: as measured.
        """
        order = self.compared.harmonic_order
        corrected = with_corrected_records(data, self.chosen.rows, self.chosen.sensors, added)
        records = _records(self.given, corrected, order, self.error_scale)
        return dataclasses.replace(self, **records, added=added)

    def with_errors_scaled(self, factor: float) -> "Predictions":
        """The predictions with all errors of force, velocities and phases scaled."""
        states = self.chosen.states
        scaled = self.chosen._replace(states=states._replace(error=factor * states.error))
        return dataclasses.replace(self, chosen=scaled, error_scale=factor * self.error_scale)

    def with_phases(self, phase: Float[np.ndarray, " state"]) -> "Predictions":
        """The predictions with unknown phases of velocities set to these, rad."""
        states, unknown = self.chosen.states, self.chosen.phase_unknown[:, :1]
        rotation = np.where(unknown, np.exp(1j * phase)[:, None], 1.0)
        rotated = self.chosen._replace(states=states._replace(velocity=states.velocity * rotation))
        return dataclasses.replace(self, chosen=rotated)

    def whitened_for(
        self,
        by_error: Float[np.ndarray, "state column input"],
        phasors: Complex[np.ndarray, "state part"],
    ) -> tuple[Float[np.ndarray, "state column column"], Bool[np.ndarray, "state column"]]:
        """Whitening of the states and used columns, for a model's phasors and errors."""
        chosen = self.chosen
        if self.magnitudes.alone.any():
            std = self.magnitudes.own_std(np.asarray(chosen.states.own_std), phasors)
            chosen = chosen._replace(states=chosen.states._replace(own_std=jnp.asarray(std)))
        parts = [padded(np.asarray(part), _ROOM) for part in (*chosen.states, by_error)]
        *columns, errors = jax.device_put(parts)
        whitener = state_whitener(CalibrationStates(*columns), errors, jnp.zeros(()))
        whiten = np.asarray(whitener)[: len(by_error)]
        used = np.any(whiten != 0, axis=(1, 2))
        return whiten, np.asarray(chosen.states.known) & used[:, None]

    def of(
        self, values: Float[np.ndarray, "trial parameter"], along: Sequence[str] = ()
    ) -> Predicted:
        """The misfit of the states for each trial's parameters, and derivatives by some."""
        group, indices = self.group, self.group.indices(along)
        # Finite differences over a small fraction of a clearly detectable change. The unit of a
        # shape may be a guess: its own magnitude is used unless zero.
        magnitude = np.abs(values)
        length = np.maximum(group.unit, np.where(group.is_strength, magnitude, 0.0))
        shape_length = np.clip(magnitude, 1e-6 * group.unit, group.unit)
        length = np.where(group.is_shape & (magnitude > 0), shape_length, length)[:, indices]
        steps = _Steps(indices, length, np.zeros((self.states.error.shape[1], len(indices))))
        columns, slopes = self._by_batches(values, steps)
        slopes = slopes / length[:, None, None]
        if self.offset is not None:
            columns = columns + self.offset
        compared = self.magnitudes.compared(columns, slopes)
        return Predicted(*compared, self.magnitudes.phasors(columns))

    def by_error(
        self, values: Float[np.ndarray, " parameter"]
    ) -> tuple[Float[np.ndarray, "state column input"], Complex[np.ndarray, "state part"]]:
        """Derivatives by the states' errors, propagated through a model with these parameters.

        Gain and phase errors act on the model's prediction, not on the measured value: otherwise
        free level gains would fit the noise (D'Agostini, doi:10.1016/0168-9002(94)90719-6).
        Also returns the model's phasors.
        """
        inputs, unit = self.states.error.shape[1], 0.1  # of a logarithm, or rad
        steps = _Steps(np.full(inputs, -1), np.zeros((1, inputs)), unit * np.eye(inputs))
        columns, slopes = self._by_batches(values[None], steps)
        slopes = slopes / unit - self._by_error_of_residual(columns)
        derivatives = self.magnitudes.compared(columns, slopes, of_errors=True)[1]
        return derivatives[0], self.magnitudes.phasors(columns)[0]

    def _by_error_of_residual(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Float[np.ndarray, "trial state column input"]:
        """Derivatives of the misfit of other sensors and harmonics by gains and phases.

        Both act on a sensor's motion; a phase error φ rotates harmonic h by hφ.
        """
        orders, n = self.chosen.orders, len(self.chosen.sensors)
        sensor = [*range(1, n), *np.repeat(np.arange(n), len(orders))]
        order = [*[1] * (n - 1), *orders * n]
        derivatives = np.zeros((*columns.shape, 1 + 2 * n))
        for k, (s, h) in enumerate(zip(sensor, order, strict=True), 1):
            residual = columns[..., 2 * k] + 1j * columns[..., 2 * k + 1]
            for index, by in ((1 + s, residual), (1 + n + s, 1j * h * residual)):
                derivatives[..., 2 * k, index], derivatives[..., 2 * k + 1, index] = (
                    by.real,
                    by.imag,
                )
        return derivatives

    def _by_batches(
        self, values: Float[np.ndarray, "trial parameter"], steps: "_Steps"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and derivatives, by batches of directions."""
        wanted, parts = len(steps.parameter), []
        for begin in range(0, max(wanted, 1), _DIRECTIONS):
            some = [a[..., begin : begin + _DIRECTIONS] for a in steps]
            room = [(0, _DIRECTIONS - some[0].size)]
            filled = _Steps(*(np.pad(a, [(0, 0)] * (a.ndim - 1) + room) for a in some))
            parts.append(self._evaluated(values, filled, min(wanted - begin, _DIRECTIONS)))
        return parts[0][0], np.concatenate([slope for _, slope in parts], axis=3)[..., :wanted]

    def _evaluated(
        self, values: Float[np.ndarray, "trial parameter"], steps: "_Steps", wanted: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and derivatives."""
        group = self.group
        used = np.any(values != group.values, axis=0)
        used[steps.parameter[:wanted][steps.parameter[:wanted] >= 0]] = True
        active = np.zeros(group.force.max() + 1, dtype=bool)
        active[group.force[used & (group.force >= 0)]] = True
        n, trials = len(self.chosen.rows), len(values)
        state, trial = np.tile(np.arange(n), trials), np.repeat(np.arange(trials), n)
        how = programs.Settings(group.names, self.compared, len(self.model.effects))

        def block(some: np.ndarray) -> list[np.ndarray]:
            at = padded(some, _BLOCK)
            first = int(trial[some[0]])
            near = slice(first, first + _BLOCK)  # a block has no more trials than rows
            ours = [padded(a[near], _BLOCK) for a in (values, steps.length)]
            arrays: list[Any] = [*ours, steps.parameter, steps.by_error, active, np.array(wanted)]
            arrays += [state[at], trial[at] - first]
            output = programs.misfit_columns(
                group.model, how, self.motions, programs.Trials(*arrays)
            )
            return [np.asarray(a)[: len(some), self.own_columns] for a in output]

        rows = np.arange(n * trials)
        parts = over_cores(block, np.split(rows, range(_BLOCK, len(rows), _BLOCK)))
        results = (np.concatenate(column) for column in zip(*parts, strict=True))
        columns, slopes = (a.reshape(trials, n, *a.shape[1:]) for a in results)
        return columns, slopes


def predictions_of(
    model: Structure,
    data: SteadyStates,
    force_gain_std: float = 0.0,
    *,
    harmonics: int = programs.HARMONICS,
    kinds: Iterable[str] | None = None,
) -> Predictions:
    """Predictions of a model for measured states, with the baseline's motions solved.

    `force_gain_std`: relative 1σ of a gain common to all forces; `harmonics`: number of those of
    the motions; `kinds`: effects available to candidates, all known ones if None: the compiled
    programs grow with their number.
    """
    model = dataclasses.replace(model, name="")  # the name would be static in the compiled programs
    records = _records(model, data, harmonics)
    numbers, kinds = parameter_values(model), EFFECTS if kinds is None else kinds
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
        group=_with_effects(model, motion_scales(model, records["chosen"]), kinds),
    )


def _records(
    model: Structure, data: SteadyStates, harmonics: int, error_scale: float = 1.0
) -> dict[str, Any]:
    """The fields of `Predictions` that depend on the records, with the baseline's motions."""
    chosen = calibration_states(model, data, programs.HARMONICS)
    # On the host: JAX operations recompile for every number of states.
    on_host: Any = jax.tree.map(np.asarray, chosen.states)
    error = on_host.error
    # An unstated force error is a fraction of the velocity's: on a steep curve amplitude errors
    # act on the frequency, and without a force error the damping would be exact.
    force = np.where(error[:, :1] > 0, error[:, :1], FORCE_TO_VELOCITY * error[:, 1:2])
    error = error_scale * np.concatenate([force, error[:, 1:]], axis=1)
    chosen = chosen._replace(states=on_host._replace(error=error))
    columns, orders, own_columns = _widened(chosen)
    compared = programs.ComparedMotion(chosen.sensors, orders, harmonics)

    def motions(*rows: Array) -> tuple[Array, Array]:
        return programs.grown(model, CalibrationStates(*rows), compared)

    solved = by_blocks(motions, 16, *columns)  # by continuation in amplitude
    arrays = jax.device_put([padded(rows, _ROOM) for rows in (*columns, *solved)])
    every: list[Any] = columns
    return {
        "chosen": chosen,
        "magnitudes": magnitudes_of(chosen),
        "states": CalibrationStates(*every),
        "compared": compared,
        "own_columns": own_columns,
        "motions": programs.Stored(CalibrationStates(*arrays[:-2]), *arrays[-2:]),
    }


def _of_modal_mass(model: Structure, force_gain_std: float) -> dict[str, float]:
    """1σ of the participation from the stated one of the modal mass 1/(Φ_r Φᵀb).

    None with a free force gain, which the modal mass cannot be separated from.
    """
    modes, j = model.modes, model.modes.mode_of_interest
    if modes.modal_mass_std is None or force_gain_std > 0:
        return {}
    std = abs(modes.participation.item(j)) * modes.modal_mass_std.item(j)
    return {f"mode_{j + 1}.participation": std} if std > 0 else {}


def _with_effects(baseline: Structure, scales: MotionScales, kinds: Iterable[str]) -> Group:
    """The structure with effects of some kinds that the baseline lacks."""
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
        indices = [where[label] for label in parameter_labels(effect.kind)]
        unit[indices] = candidate(effect.kind, scales).unit
        is_strength[indices[0]], is_shape[indices[1:]] = True, True
    return Group(model, names, values, unit, is_strength, is_shape, force)


def with_idle_effects(model: Structure, kinds: Sequence[str]) -> Structure:
    """The model with further effects at zero strength: the same physics."""
    modes, j = model.modes, model.modes.mode_of_interest
    mode = modes.natural_frequency.item(j), modes.damping_ratio.item(j)
    added = tuple(without_strength(kind, *mode) for kind in kinds)
    return dataclasses.replace(model, effects=(*model.effects, *added))


def _widened(chosen: ComparedColumns) -> tuple[list[np.ndarray], tuple[int, ...], np.ndarray]:
    """States with padded harmonics for the programs, these orders, and the measured columns.

    States of a further test may have harmonics that the measured ones lack: one program for both.
    """
    n, n_sensors = chosen.states.velocity.shape
    orders = tuple(sorted({*programs.COMPARED, *chosen.orders}))
    indices = np.array([orders.index(h) for h in chosen.orders], dtype=int)
    harmonics = np.zeros((n, n_sensors, len(orders)), dtype=complex)
    harmonics[:, :, indices] = chosen.states.harmonics
    first = n_sensors + len(orders) * np.arange(n_sensors)[:, None]
    phasors = np.append(np.arange(n_sensors), first + indices)
    columns = (2 * phasors[:, None] + np.arange(2)).reshape(-1)
    wide = np.zeros((2, n, 2 * n_sensors * (1 + len(orders))))
    # Programs return both parts, also of phasors compared by magnitude.
    known = np.asarray(chosen.states.known)[:, ::2]
    wide[:, :, columns] = chosen.states.own_std, np.repeat(known, 2, axis=1)
    widened = {"harmonics": harmonics, "own_std": wide[0], "known": wide[1] > 0}
    parts = [np.asarray(a) for a in (chosen.states._asdict() | widened).values()]
    return parts, orders, columns


def scales_of(predictions: Predictions) -> MotionScales:
    """Typical magnitudes of the measured motions."""
    return motion_scales(predictions.model, predictions.chosen)


def with_corrected_records(
    data: SteadyStates,
    rows: Int[np.ndarray, " state"],
    sensors: tuple[int, ...],
    added: Float[np.ndarray, "state input"],
) -> SteadyStates:
    """The data with log velocities and phases corrected by `added` for the states in `rows`."""
    plain: Any = jax.tree.map(np.asarray, data)
    n = len(sensors)
    factor, rotation = np.ones((data.n_states, n)), np.zeros((data.n_states, n))
    factor[rows], rotation[rows] = np.exp(added[:, 1 : n + 1]), added[:, n + 1 :]
    back = np.argsort(sensors)
    factor, rotation = factor[:, back], rotation[:, back]
    orders = np.array(data.harmonic_order, dtype=int)
    corrected: SteadyStates = dataclasses.replace(
        plain,
        velocity=plain.velocity * (factor * np.exp(1j * rotation)),
        velocity_std=plain.velocity_std * factor,
        harmonics=plain.harmonics * factor[:, :, None] * np.exp(1j * rotation[:, :, None] * orders),
        harmonic_std=plain.harmonic_std * factor,
    )
    return corrected
