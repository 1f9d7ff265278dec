"""What a model with an effect says of measured states: the force and the harmonics they need.

Effects stand in a structure without strength, so that one program answers for many candidates:
a candidate is a vector of parameters.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.identify.calibration_states import (
    CalibrationStates,
    Selection,
    calibration_states,
    state_whitener,
)
from snrmjax.identify.needed_force import held_state, missed_columns
from snrmjax.measure.steady_states import SteadyStates
from snrmjax.model.effect_base import (
    AbstractAddedMode,
    AbstractEffect,
    AbstractHysteresis,
    AbstractKinked,
)
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.model.parameters import parameter_names, parameter_value, with_parameters
from snrmjax.model.structure import Structure
from snrmjax.simulate.blocks import by_blocks, mapped
from snrmjax.simulate.compiled import compiled

HARMONICS = 5
"""Of the motions: one sees three of them, and two more bend those."""

_BLOCK = 64  # rows of a program: a state under one vector of parameters each
_DIRECTIONS = 6  # derivatives that a call gives


class Group(NamedTuple):
    """A structure with several effects without strength, and how it moves then."""

    model: Structure
    names: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    near: Float[np.ndarray, "state entry"]

    def place(self, name: str) -> int:
        """Where a parameter is."""
        return self.names.index(name)


class Predicted(NamedTuple):
    """Columns of all states for several trials, and their derivatives along given directions.

    NaN where no motion was found. A column is what is missed of the force, relative to the
    measured one, or of a harmonic, relative to the measured velocity: real and imaginary parts.
    """

    columns: Float[np.ndarray, "trial state column"]
    slopes: Float[np.ndarray, "trial state column direction"]


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

    def __init__(self, model: Structure, data: SteadyStates):
        # Its name would be a part of the programs.
        self.model = dataclasses.replace(model, name="")
        self.chosen = calibration_states(model, data, HARMONICS)
        self.held = (self.chosen.sensors, self.chosen.orders, HARMONICS)
        self.states: list[np.ndarray] = [np.asarray(part) for part in self.chosen.states]
        self.level_numbers = np.asarray(data.level)[self.chosen.rows]
        self._groups: dict[str, Group] = {}

    def group(self, kind: str) -> Group:
        """The structure that has this kind of effect.

        Effects that are quick to follow share one; friction, contacts and further modes, which
        need many samples of a cycle or more unknowns, have programs of their own beside them.
        """
        own = [k for k in EFFECTS if _family(k) in ("", _family(kind))]
        key = _family(kind)
        if key not in self._groups:
            self._groups[key] = self._prepared(own, grow=key in ("", *_ADDED))
        return self._groups[key]

    def scale_errors(self, factor: float) -> None:
        """Take all errors of force, velocities and phases so many times larger."""
        states = self.chosen.states
        self.chosen = self.chosen._replace(states=states._replace(error=factor * states.error))
        self.states = [np.asarray(part) for part in self.chosen.states]

    def is_apart(self, kind: str) -> bool:
        """Whether a kind has a program of its own."""
        return _family(kind) != ""

    def _prepared(self, kinds: list[str], *, grow: bool) -> Group:
        present = [effect.kind for effect in self.model.effects]
        added = tuple(_without_strength(k, self.model) for k in kinds if k not in present)
        model = dataclasses.replace(self.model, effects=(*self.model.effects, *added))
        names = parameter_names(model)
        values = np.array([float(parameter_value(model, name)) for name in names])
        if not grow:  # without strength an effect changes no motion
            return Group(model, names, values, self.group(PLAIN).near)
        near = by_blocks(
            lambda *rows: (_grown(model, CalibrationStates(*rows), self.held),),
            _BLOCK,
            *self.states,
        )[0]
        return Group(model, names, values, near)

    def of(
        self,
        group: Group,
        values: Float[np.ndarray, "trial parameter"],
        directions: Float[np.ndarray, "trial parameter direction"],
    ) -> Predicted:
        """What the states miss under every trial's parameters."""
        n = len(self.chosen.rows)
        trials, wanted = len(values), directions.shape[2]
        rows = [np.tile(a, (trials, *(1,) * (a.ndim - 1))) for a in self.states]
        near = np.tile(group.near, (trials, 1))
        each = np.repeat(values, n, axis=0)
        columns: np.ndarray = np.empty(0)
        slopes = []
        for begin in range(0, max(wanted, 1), _DIRECTIONS):
            some = directions[:, :, begin : begin + _DIRECTIONS]
            some = np.pad(some, ((0, 0), (0, 0), (0, _DIRECTIONS - some.shape[2])))
            arrays = (*rows, each, np.repeat(some, n, axis=0), near)
            columns, slope = by_blocks(
                lambda *block: _missed(group.model, group.names, self.held, *block), _BLOCK, *arrays
            )
            slopes.append(slope)
        width = columns.shape[1]
        every = np.concatenate(slopes, axis=2)[:, :, :wanted]
        return Predicted(columns.reshape(trials, n, width), every.reshape(trials, n, width, wanted))

    def by_error(
        self, group: Group, values: Float[np.ndarray, " parameter"]
    ) -> Float[np.ndarray, "state column input"]:
        """Derivatives by the states' errors, as a model with these parameters passes them on."""
        each = np.tile(values, (len(self.chosen.rows), 1))
        return by_blocks(
            lambda *block: (_by_error(group.model, group.names, self.held, *block),),
            _BLOCK,
            *self.states,
            each,
            group.near,
        )[0]


def whitened_states(
    chosen: Selection, by_error: Float[np.ndarray, "state column input"]
) -> Measured:
    """The states with the whitening that follows from their errors."""
    whiten = np.asarray(state_whitener(chosen.states, jnp.asarray(by_error), jnp.zeros(())))
    used = np.any(whiten != 0, axis=(1, 2))
    return Measured(chosen, by_error, whiten, np.asarray(chosen.states.known) & used[:, None])


PLAIN = "cubic_stiffness"
"""A kind that every program of quick effects has."""

_ADDED = tuple(kind for kind, e in EFFECTS.items() if issubclass(e, AbstractAddedMode))


_LIBRARY = frozenset(EFFECTS)


def _family(kind: str) -> str:
    """Which program answers for a kind of effect; a user's own cannot spoil another's."""
    if kind not in _LIBRARY:
        return kind
    effect = EFFECTS[kind]
    if issubclass(effect, AbstractKinked):
        return "kinked"
    return kind if issubclass(effect, (AbstractHysteresis, AbstractAddedMode)) else ""


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


_Held = tuple[tuple[int, ...], tuple[int, ...], int]


@compiled
def _grown(model: Structure, states: CalibrationStates, held: _Held) -> Float[Array, "row entry"]:
    def one(*row: Array) -> Array:
        state = CalibrationStates(*row)
        return held_state(model, state, state.velocity[0], held[0][0], held[2]).grown()

    return mapped(one, *states)


@compiled
def _missed(
    model: Structure, names: tuple[str, ...], held: _Held, *rows: Array
) -> tuple[Float[Array, "row column"], Float[Array, "row column direction"]]:
    def one(*row: Array) -> tuple[Array, Array]:
        *state, values, directions, near = row

        def of(change: Array) -> tuple[Array, Array]:
            changed = with_parameters(model, names, values + directions @ change)
            none = jnp.zeros_like(state[6])
            found = missed_columns(changed, CalibrationStates(*state), held, 1.0, none, near)[0]
            return found, found

        slopes, columns = jax.jacfwd(of, has_aux=True)(jnp.zeros(directions.shape[1]))
        return columns, slopes

    return mapped(one, *rows)


@compiled
def _by_error(
    model: Structure, names: tuple[str, ...], held: _Held, *rows: Array
) -> Float[Array, "row column input"]:
    def one(*row: Array) -> Array:
        *state, values, near = row
        changed = with_parameters(model, names, values)

        def of(error: Array) -> Array:
            return missed_columns(changed, CalibrationStates(*state), held, 1.0, error, near)[0]

        return jax.jacfwd(of)(jnp.zeros_like(state[6]))

    return mapped(one, *rows)
