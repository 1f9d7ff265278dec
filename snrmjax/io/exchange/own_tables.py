"""Tables with the columns of our CSV: detected, read, and converted from other units."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from snrmjax.io.columns import is_ours
from snrmjax.io.exchange.import_map import ImportMap
from snrmjax.io.exchange.import_units import AMPLITUDE_FACTORS, force_meaning, motion_meaning
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.io.rows import header_of
from snrmjax.io.tables import steady_states_of_fields
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.velocity_states import velocity_factors
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError


def is_own_file(path: Path) -> bool:
    """Whether a CSV has our header; our reader then reports any error."""
    return is_ours(header_of(path))


def states_of_own_table(table: NumberTable, file: str) -> SteadyStates:
    """Steady states of a table with the columns of our CSV.

    Raises `ValueError` as `read_steady_states` does.
    """
    fields = {name: [_text(value) for value in column] for name, column in table.columns.items()}
    if "sensor" in table.words:
        fields["sensor"] = list(table.words["sensor"])
    return steady_states_of_fields(fields, file)


def restated(states: SteadyStates, mapping: ImportMap) -> SteadyStates:
    """Steady states in SI, of our table with numbers in other units than the columns state.

    Arguments: of `mapping` the `unit` of the velocity columns (possibly of an acceleration), the
    `force_unit` (a voltage makes it a drive), `amplitude` and `phase_sign`.
    Raises `ValueError` for units of neither a motion nor a force.
    """
    orders = (1, *states.harmonic_order)
    factors = np.ones((states.n_states, len(orders)), dtype=complex)
    if mapping.unit:
        quantity, factor, _ = motion_meaning("", mapping.unit, "", "the velocity")
        channel = Channel("", quantity)
        factors = factor * velocity_factors([channel], orders, np.asarray(states.frequency))[:, 0]
    factors = factors * AMPLITUDE_FACTORS[mapping.amplitude]
    phasors = np.concatenate(
        [np.asarray(states.velocity)[:, :, None], np.asarray(states.harmonics)], axis=2
    )
    phasors = phasors * factors[:, None]
    if mapping.phase_sign == "lag":
        phasors = phasors.conj()
    magnitude = np.abs(factors[:, :1])
    # The stated std is the rms over harmonics, whose noise is equal in the columns' unit.
    noisy = [k for k, order in enumerate(orders) if k and order > 0]
    floor = np.sqrt(np.mean(np.abs(factors[:, noisy]) ** 2, axis=1, keepdims=True)) if noisy else 1
    changed = dataclasses.replace(
        states,
        velocity=jnp.asarray(phasors[:, :, 0]),
        harmonics=jnp.asarray(phasors[:, :, 1:]),
        velocity_std=states.velocity_std * magnitude,
        harmonic_std=states.harmonic_std * floor,
    )
    return _with_force(changed, mapping)


def _with_force(states: SteadyStates, mapping: ImportMap) -> SteadyStates:
    """With the force, or the drive in its place, converted from the stated unit."""
    if states.base is not None:
        return _with_base(states, mapping)
    force = force_meaning(mapping, "N", "the force")
    factor = force.factor * AMPLITUDE_FACTORS[mapping.amplitude]
    missing = jnp.full(states.n_states, jnp.nan)
    known = jnp.isfinite(states.force)
    if not mapping.force_unit:
        drive, newtons = states.drive * AMPLITUDE_FACTORS[mapping.amplitude], states.force * factor
    else:
        loads = factor * jnp.where(known, states.force, states.drive)
        drive, newtons = (loads, missing) if force.is_voltage else (missing, loads)
    std = missing if force.is_voltage else states.force_std * factor
    return dataclasses.replace(states, force=newtons, drive=drive, force_std=std)


def _with_base(states: SteadyStates, mapping: ImportMap) -> SteadyStates:
    """With the base acceleration converted from the stated unit."""
    factor = AMPLITUDE_FACTORS[mapping.amplitude]
    if mapping.force_unit:
        quantity, by_unit, _ = motion_meaning(
            "", mapping.force_unit, "", "the base", option="--force-unit"
        )
        if quantity != "acceleration":
            raise InputError(
                f"--force-unit of a table with a base's acceleration must be one of acceleration, "
                f"but {mapping.force_unit} is of {quantity}."
            )
        factor *= by_unit
    return dataclasses.replace(
        states, force=states.force * factor, force_std=states.force_std * factor
    )


def restated_how(mapping: ImportMap) -> Fact:
    """Note on the units and conventions converted."""
    return Fact(
        "our_own_table",
        unit=mapping.unit,
        force_unit=mapping.force_unit,
        amplitude="" if mapping.amplitude == "peak" else mapping.amplitude,
        conjugated=mapping.phase_sign == "lag",
    )


def _text(value: float) -> str:
    """A number in full precision; empty for NaN, whole numbers without a point."""
    number = float(value)
    if np.isnan(number):
        return ""
    return str(int(number)) if number.is_integer() and abs(number) < 2**53 else repr(number)
