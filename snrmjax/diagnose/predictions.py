"""What a model with an effect says of measured states: the force and the harmonics they need.

Effects stand in a structure without strength, so that one program answers for many candidates:
a candidate is a vector of parameters.
"""

import copy
import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.diagnose import programs
from snrmjax.diagnose.amplitudes import sizes_of
from snrmjax.identify.calibration_states import (
    CalibrationStates,
    Selection,
    calibration_states,
    state_whitener,
)
from snrmjax.measure.steady_states import SteadyStates
from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.model.parameters import parameter_names, parameter_value
from snrmjax.model.structure import Structure
from snrmjax.simulate.blocks import by_blocks, over_cores, padded

_BLOCK = 64  # rows of a program: a state under one vector of parameters each
_DIRECTIONS = 3  # derivatives that a call gives
_TRIALS = _BLOCK  # that may meet in a block, at most


class Group(NamedTuple):
    """A structure with several effects without strength."""

    model: Structure
    names: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    force: Int[np.ndarray, " parameter"]  # of the added forces, whose it is; −1: of none

    def place(self, name: str) -> int:
        """Where a parameter is."""
        return self.names.index(name)


class Predicted(NamedTuple):
    """Columns of all states for several trials, and their derivatives along given directions.

    NaN where no motion was found. A column is what is missed of the force, relative to the
    measured one, or of a harmonic, relative to the measured velocity: real and imaginary parts, or
    the size and nothing where the phase is unknown. The phasors are what the model has, and are
    relative to a velocity of unknown phase.
    """

    columns: Float[np.ndarray, "trial state column"]
    slopes: Float[np.ndarray, "trial state column direction"]
    phasors: Complex[np.ndarray, "trial state part"]
    force_slopes: Complex[np.ndarray, "trial state direction"]


class Measured(NamedTuple):
    """The states, their whitening and what of them was measured."""

    chosen: Selection
    by_error: Float[np.ndarray, "state column input"]
    whiten: Float[np.ndarray, "state column column"]
    known: Bool[np.ndarray, "state column"]

    @property
    def states(self) -> CalibrationStates:
        """The states themselves."""
        return self.chosen.states


class Predictions:
    """Answers for one model and one set of data."""

    def __init__(self, model: Structure, data: SteadyStates, force_gain_std: float = 0.0):
        # Its name would be a part of the programs.
        self.model = dataclasses.replace(model, name="")
        self.chosen = calibration_states(model, data, programs.HARMONICS)
        self.held = (self.chosen.sensors, self.chosen.orders, programs.HARMONICS)
        self.sizes = sizes_of(self.chosen)
        # Of a phasor whose size alone counts the programs give both parts.
        both = jnp.repeat(self.chosen.states.known[:, ::2], 2, axis=1)
        self.states = [np.asarray(p) for p in self.chosen.states._replace(known=both)]
        self.level_numbers = np.asarray(data.level)[self.chosen.rows]
        self.force_gain_std = force_gain_std
        self._groups: dict[str, Group] = {}
        found = by_blocks(self._baseline_motions, _BLOCK, *self.states)
        # Room for a power of two of states: few sizes compile.
        room = [padded(rows) for rows in (*self.states, *found)]
        arrays = jax.device_put(room)
        self._stored = programs.Stored(CalibrationStates(*arrays[:-2]), *arrays[-2:])

    def _baseline_motions(self, *rows: Array) -> tuple[Array, Array]:
        states = CalibrationStates(*rows)
        near = programs.grown(self.model, states, self.held)
        return near, programs.inverse_jacobian(self.model, states, near, self.held)

    def group(self, kind: str) -> Group:
        """The structure that has this kind of effect.

        The library shares one; effects of a user have structures of their own, which have the
        library's too.
        """
        key = kind if kind not in _LIBRARY else ""
        if key not in self._groups:
            self._groups[key] = self._prepared([k for k in EFFECTS if k in _LIBRARY or k == kind])
        return self._groups[key]

    def scale_errors(self, factor: float) -> None:
        """Take all errors of force, velocities and phases so many times larger."""
        states = self.chosen.states
        self.chosen = self.chosen._replace(states=states._replace(error=factor * states.error))

    def turned(self, phase: Float[np.ndarray, " state"]) -> "Predictions":
        """The same with velocities of unknown phase at these phases, rad."""
        states, unknown = self.chosen.states, self.chosen.phase_unknown[:, :1]
        turn = np.where(unknown, np.exp(1j * phase)[:, None], 1.0)
        other = copy.copy(self)
        other.chosen = self.chosen._replace(states=states._replace(velocity=states.velocity * turn))
        return other

    def weighed(
        self,
        by_error: Float[np.ndarray, "state column input"],
        phasors: Complex[np.ndarray, "state part"],
    ) -> Measured:
        """The states with the whitening of a model that passes errors on so and has the phasors."""
        chosen = self.chosen
        if self.sizes.alone.any():
            own = self.sizes.own_std(np.asarray(chosen.states.own_std), phasors)
            chosen = chosen._replace(states=chosen.states._replace(own_std=jnp.asarray(own)))
        return whitened_states(chosen, by_error)

    def is_apart(self, kind: str) -> bool:
        """Whether a kind has a program of its own."""
        return kind not in _LIBRARY

    def _prepared(self, kinds: list[str]) -> Group:
        present = [effect.kind for effect in self.model.effects]
        added = tuple(_without_strength(k, self.model) for k in kinds if k not in present)
        model = dataclasses.replace(self.model, effects=(*self.model.effects, *added))
        names = parameter_names(model)
        values = np.array([float(parameter_value(model, name)) for name in names])
        kinds = [added[k].kind for k in programs.forces_of(added)]
        owner = [name.split(".")[0] for name in names]
        force = np.array([kinds.index(o) if o in kinds else -1 for o in owner])
        return Group(model, names, values, force)

    def of(
        self,
        group: Group,
        values: Float[np.ndarray, "trial parameter"],
        directions: Float[np.ndarray, "trial parameter direction"],
    ) -> Predicted:
        """What the states miss under every trial's parameters."""
        none = np.zeros((self.states[6].shape[1], _DIRECTIONS))
        wanted = directions.shape[2]
        parts = [
            self._answers(
                group, values, _filled(directions[:, :, begin : begin + _DIRECTIONS]), none
            )
            for begin in range(0, max(wanted, 1), _DIRECTIONS)
        ]
        slopes = np.concatenate([slope for _, slope in parts], axis=3)[..., :wanted]
        columns, phasors = parts[0][0], self.sizes.phasors(parts[0][0])
        force_slopes = slopes[:, :, 0] + 1j * slopes[:, :, 1]
        return Predicted(*self.sizes.compared(columns, slopes), phasors, force_slopes)

    def by_error(
        self, group: Group, values: Float[np.ndarray, " parameter"]
    ) -> tuple[Float[np.ndarray, "state column input"], Complex[np.ndarray, "state part"]]:
        """Derivatives by the states' errors, as a model with these parameters passes them on.

        Returns the model's phasors too.
        """
        inputs = self.states[6].shape[1]
        none = np.zeros((1, len(values), _DIRECTIONS))
        parts = [
            self._answers(group, values[None], none, _filled(some))
            for some in np.split(np.eye(inputs), range(_DIRECTIONS, inputs, _DIRECTIONS), axis=1)
        ]
        slopes = np.concatenate([slope for _, slope in parts], axis=3)[..., :inputs]
        columns = parts[0][0]
        found = self.sizes.compared(columns, slopes, of_errors=True)[1]
        return found[0], self.sizes.phasors(columns)[0]

    def _answers(
        self,
        group: Group,
        values: Float[np.ndarray, "trial parameter"],
        by_value: Float[np.ndarray, "trial parameter direction"],
        by_error: Float[np.ndarray, "input direction"],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and slopes: friction by its formulas, and marching where they fail."""
        used = np.any(values != group.values, axis=0) | np.any(by_value, axis=(0, 2))
        active = np.zeros(group.force.max() + 1, dtype=bool)
        active[group.force[used & (group.force >= 0)]] = True
        fixed = (group.model, group.names, self.held, len(self.model.effects))
        n, trials = len(self.chosen.rows), len(values)
        state, trial = np.tile(np.arange(n), trials), np.repeat(np.arange(trials), n)

        def answered(swings: bool, rows: np.ndarray) -> tuple[np.ndarray, ...]:
            def block(some: np.ndarray) -> list[np.ndarray]:
                at = padded(some, _BLOCK)
                first = int(trial[some[0]])
                near = slice(first, first + _TRIALS)
                ours = [padded(a[near], _TRIALS) for a in (values, by_value)]
                table = programs.Trials(*jax.device_put((*ours, by_error)))
                arrays = (active, self._stored, table, state[at], trial[at] - first)
                found = programs.missed(*fixed, swings, *arrays)
                return [np.asarray(a)[: len(some)] for a in found]

            blocks = np.split(rows, range(_BLOCK, len(rows), _BLOCK))
            parts = over_cores(block, blocks)
            return tuple(np.concatenate(column) for column in zip(*parts, strict=True))

        found = answered(True, np.arange(n * trials))
        left = np.flatnonzero(~np.isfinite(found[0]).all(axis=1))
        slides = any(group.names[k].split(".")[0] in _SLIDING for k in np.flatnonzero(used))
        if left.size and slides:
            for part, own in zip(found, answered(False, left), strict=True):
                part[left] = own
        columns, slopes = (a.reshape(trials, n, *a.shape[1:]) for a in found)
        return columns, slopes


def _filled(directions: Float[np.ndarray, "*entry some"]) -> np.ndarray:
    room = np.zeros((*directions.shape[:-1], _DIRECTIONS))
    room[..., : directions.shape[-1]] = directions
    return room


def whitened_states(
    chosen: Selection, by_error: Float[np.ndarray, "state column input"]
) -> Measured:
    """The states with the whitening that follows from their errors."""
    whiten = np.asarray(state_whitener(chosen.states, jnp.asarray(by_error), jnp.zeros(())))
    used = np.any(whiten != 0, axis=(1, 2))
    return Measured(chosen, by_error, whiten, np.asarray(chosen.states.known) & used[:, None])


PLAIN = "cubic_stiffness"
"""A kind of the library, whose program also answers for the baseline by itself."""

_LIBRARY = frozenset(EFFECTS)
_SLIDING = frozenset({"jenkins_slider", "iwan_microslip"})


def _without_strength(kind: str, model: Structure) -> AbstractEffect:
    """An effect that does nothing, with shapes that no rule forbids."""
    frequency = float(model.modes.natural_frequency[model.modes.mode_of_interest])
    ratio = float(model.modes.damping_ratio[model.modes.mode_of_interest])
    shapes = {
        "gap_stiffness": {"gap": 1.0},
        "one_sided_stop": {"gap": 1.0},
        "jenkins_slider": {"slip_displacement": 1.0},
        "iwan_microslip": {"exponent": 1.5},
        "internal_resonance_1_3": {
            "frequency_hz": 3.3 * frequency / (2 * np.pi),
            "damping_ratio": ratio,
        },
        "internal_resonance_1_2": {
            "frequency_hz": 2.2 * frequency / (2 * np.pi),
            "damping_ratio": ratio,
        },
    }
    zero = dict.fromkeys(effect_parameters(kind), 0.0)
    return make_effect(kind, zero | shapes.get(kind, {}))
