"""A study: one model, varied quantities and a computation, checked before it runs."""

import dataclasses
import difflib
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.beam_models import BeamModels
from snrmjax.condense.beam_parameters import RADIUS, RISE, beam_rules, check_beam_name
from snrmjax.model.parameters import (
    parameter_names,
    parameter_rules,
    parameter_value,
    with_parameters,
)
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.names import with_former_attributes
from snrmjax.numerics.rules import POSITIVE, InputError, Rule
from snrmjax.numerics.units import HERTZ
from snrmjax.study.computations.base import (
    FORCE,
    AbstractComputation,
    Failure,
    Members,
    refusal,
    with_refused,
)
from snrmjax.study.sampling import Sampling, drawn_members, member_seed, number_of_members
from snrmjax.study.variations import AbstractVariation

_IN_HERTZ = ".frequency_hz"  # alternative to `natural_frequency` in rad/s, as in model files
_STRANGE = 3.0  # ratio to the model's frequency above which a unit error is assumed


@with_former_attributes({"sensor_told": "reported_sensor"})
class Study(eqx.Module):
    """Many members of one model and the computation for each.

    `variations` have names of model parameters as in `parameter_names` ("mode_1.damping_ratio";
    natural frequencies in rad/s, or as "mode_1.frequency_hz" in Hz), and `force_n`. With
    `model_of`, a function of the varied values by name, other names are possible: it makes the
    model of a member, and its `ValueError` becomes the member's status. `BeamModels` make it from
    the numbers of a beam file ("section.thickness_m") and those of the model. `members_a_chunk`
    is the number computed and stored together. Peaks and velocities are those of `sensor`, by
    default the model's first; virtual tests, identifications and diagnoses use the sensor with
    the largest shape of the mode of interest.
    """

    name: str = eqx.field(static=True)
    model: Structure
    computation: AbstractComputation
    variations: tuple[AbstractVariation, ...] = ()
    sampling: Sampling = Sampling("grid")
    seed: int = eqx.field(static=True, default=0)
    members_a_chunk: int | None = eqx.field(static=True, default=None)
    model_of: Callable[[dict[str, float]], Structure] | None = eqx.field(static=True, default=None)
    sensor: str | None = eqx.field(static=True, default=None)

    @property
    def names(self) -> tuple[str, ...]:
        """The varied quantities."""
        return tuple(name for variation in self.variations for name in variation.names)

    @property
    def n_members(self) -> int:
        """Number of members."""
        return number_of_members(self.variations, self.sampling)

    @property
    def reported_sensor(self) -> str | None:
        """The sensor of peaks and velocities; None where no output refers to one.

        Raises `ValueError` for a `sensor` that the model does not have.
        """
        return self.computation.sensor(_with_sensor(self.model, self.sensor).modes)

    @property
    def chunk_size(self) -> int:
        """Number of members computed and stored together."""
        if self.members_a_chunk is None:
            return self.computation.members_a_chunk
        return self.members_a_chunk

    @property
    def n_chunks(self) -> int:
        """Number of chunks."""
        return -(-self.n_members // self.chunk_size)

    def ensemble(self) -> "Ensemble":
        """The members, drawn and checked.

        Raises `ValueError` for a quantity that the model does not have or that varies twice, for a
        missing or superfluous force, for a `sensor` that the model does not have or the outputs do
        not use, for too many members, and for the first inadmissible value.
        """
        if self.seed < 0:
            raise InputError(f"`seed` must be zero or positive, but is {self.seed}.")
        if self.members_a_chunk is not None and self.members_a_chunk < 1:
            raise InputError(
                f"`members_a_chunk` must be at least 1, but is {self.members_a_chunk}."
            )
        _check_names(self)
        _check_sensor(self)
        table = drawn_members(self.variations, self.sampling, self.seed)
        _check_values(self, table)
        return Ensemble(self, table)


class Ensemble(NamedTuple):
    """A study's members: drawn and checked."""

    study: Study
    table: Float[np.ndarray, "member name"]

    def rows_of(self, chunk: int) -> range:
        """The numbers of the members of a chunk."""
        n = self.study.chunk_size
        return range(chunk * n, min((chunk + 1) * n, len(self.table)))

    def rows(self, numbers: Sequence[int]) -> dict[str, np.ndarray]:
        """The outputs of some members; one without a model has only its status."""
        study, rows = self.study, self.table[list(numbers)]
        models = models_of(study, rows)
        solvable = [k for k, model in enumerate(models) if isinstance(model, Structure)]
        missing = {k: model for k, model in enumerate(models) if isinstance(model, Failure)}
        forces = rows[solvable][:, [study.names.index(FORCE)]] if FORCE in study.names else None
        seeds = [member_seed(study.seed, numbers[k]) for k in solvable]
        members = Members([models[k] for k in solvable], forces, seeds)  # type: ignore[misc]
        outputs = study.computation.rows(members) if solvable else None
        if outputs and not missing:
            return outputs
        return with_refused(study.computation, outputs, missing)


def models_of(study: Study, rows: Float[np.ndarray, "member name"]) -> list[Structure | Failure]:
    """The models of members for these values of the varied quantities, or their failures."""
    named = [k for k, name in enumerate(study.names) if name != FORCE]
    if study.model_of is not None:
        each = [dict(zip(study.names, row, strict=True)) for row in rows.tolist()]
        return [_made(study.model_of, values, study.sensor) for values in each]
    model = _with_sensor(study.model, study.sensor)
    if not named:
        return [model] * len(rows)
    names, units = zip(*(_in_model(study.names[k]) for k in named), strict=True)
    together = _varied(model, names, rows[:, named] * np.array(units))
    return [taken(together, k) for k in range(len(rows))]


def _made(
    model_of: Callable[[dict[str, float]], Structure],
    values: dict[str, float],
    sensor: str | None,
) -> Structure | Failure:
    if isinstance(model_of, BeamModels):
        named = {_in_model(name): value for name, value in values.items()}
        values = {name: value * unit for (name, unit), value in named.items()}
    try:
        return _with_sensor(model_of(values), sensor)
    except ValueError as error:
        return refusal(error)


def _with_sensor(model: Structure, sensor: str | None) -> Structure:
    """The model with this sensor as its first, which peaks and velocities refer to."""
    if sensor in (None, model.modes.sensors[0]):
        return model
    return dataclasses.replace(model, modes=model.modes.with_first_sensor(str(sensor)))


@compiled
def _varied(model: Structure, names: tuple[str, ...], values: Array) -> Structure:
    def numbers(row: Array) -> Structure:
        return eqx.filter(with_parameters(model, names, row), eqx.is_array)

    return eqx.combine(jax.vmap(numbers)(jnp.asarray(values)), model)


def _in_model(name: str) -> tuple[str, float]:
    """The model's name of a quantity, and the factor for its values."""
    if name.endswith(_IN_HERTZ):
        return f"{name.removesuffix(_IN_HERTZ)}.natural_frequency", HERTZ
    return name, 1.0


def _check_names(study: Study) -> None:
    names = study.names
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{name} varies twice.")
    given = {name: _in_model(name)[0] for name in names if name != FORCE}
    known = (*parameter_names(study.model), FORCE)
    if study.model_of is None:
        for name, in_model in given.items():
            if in_model not in known:
                near = difflib.get_close_matches(name, known, n=3, cutoff=0.5) or known[:3]
                raise InputError(
                    f"the model does not have the parameter {name!r}; similar ones are "
                    f"{', '.join(near)}."
                )
    if isinstance(study.model_of, BeamModels):
        for in_model in given.values():
            check_beam_name(study.model_of.stated, in_model, study.model_of.file, known)
        if {RADIUS, RISE} <= set(given):
            raise InputError(f"{RADIUS} and {RISE} cannot both vary: one follows from the other.")
    if _of_model(study) and len(set(given.values())) < len(given):
        (twice, _), *_ = Counter(given.values()).most_common(1)
        raise InputError(f"{twice} varies twice, in rad/s and in Hz.")
    forces = getattr(study.computation, "forces", None)
    stated = forces is not None and forces.values is not None
    if FORCE in names and (forces is None or stated):
        why = "`forces_n` is given too" if stated else f"{study.computation.kind} has no one force"
        raise InputError(f"{FORCE} cannot vary: {why}.")
    if forces is not None and not stated and FORCE not in names:
        raise InputError(f"{study.computation.kind} needs `forces_n`, or {FORCE} to vary.")


def _check_sensor(study: Study) -> None:
    requested, used = study.sensor, study.reported_sensor
    if requested not in (None, used):
        kind = study.computation.kind
        instead = f"uses {used}, where the mode of interest moves most"
        raise InputError(
            f"`sensor` cannot be {requested}: {kind} {instead if used else 'uses no sensor'}."
        )


def _check_values(study: Study, table: Float[np.ndarray, "member name"]) -> None:
    for k, name in enumerate(study.names):
        values = table[:, k]
        for rule in _rules(study, name):
            bad = np.flatnonzero([not rule.good(value) for value in values.tolist()])
            if bad.size:
                raise InputError(
                    f"{name} must be {rule.expected}, but member {bad[0]} of the study has "
                    f"{values[bad[0]]:g} ({bad.size} of {len(values)} members have such a value): "
                    "narrow its range, or take a distribution that stays inside, such as lognormal."
                )
        _check_unit(study, name, values)


def _rules(study: Study, name: str) -> tuple[Rule, ...]:
    if name == FORCE:
        return (POSITIVE,)
    if isinstance(study.model_of, BeamModels) and name in study.model_of.parameters:
        return beam_rules(study.model_of.stated, name, study.names)
    return parameter_rules(study.model, _in_model(name)[0]) if _of_model(study) else ()


def _of_model(study: Study) -> bool:
    """Whether names other than a beam's are parameters of the model."""
    return study.model_of is None or isinstance(study.model_of, BeamModels)


def _check_unit(study: Study, name: str, values: np.ndarray) -> None:
    """Refuse natural frequencies in Hz where rad/s are expected, and vice versa."""
    in_model, unit = _in_model(name)
    if not _of_model(study) or not in_model.endswith(".natural_frequency"):
        return
    stated = float(np.asarray(parameter_value(study.model, in_model))) / unit
    middle = float(np.median(values))
    if not 1 / _STRANGE < middle / stated < _STRANGE:
        wanted = "Hz" if unit != 1.0 else "rad/s"
        raise InputError(
            f"{name} is in {wanted}, {stated:.6g} in the model, but its values are about "
            f"{middle:.6g}: are they in the other unit?"
        )
