"""Steady states of frequency responses and spectra (UFF 58 and its relatives)."""

from collections.abc import Sequence

import numpy as np

from snrmjax.io.exchange.import_levels import MeasuredPart
from snrmjax.io.exchange.import_map import Assumption, Assumptions, ImportMap, ResponseMap
from snrmjax.io.exchange.import_units import Force, force_meaning, motion_meaning
from snrmjax.io.files import near_miss
from snrmjax.measure.recordings.channels import Channel, Quantity
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.velocity_states import velocity_factors
from snrmjax.measure.states import UNNAMED_SENSOR

_PEAK = {"": 1.0, "peak": 1.0, "rms": float(np.sqrt(2.0)), "peak_to_peak": 0.5}


def import_responses(
    sets: Sequence[FrequencyResponses],
    z: Sequence[float],
    told: ImportMap,
    file: str,
    assumed: Assumptions,
) -> tuple[MeasuredPart, ImportMap, Force, list[str]]:
    """States of sets of frequency responses, one set a level.

    The force is a channel among the responses (spectra, or responses over a generator), or the
    reference, whose amplitude the map states: one for all, one a set, or the z axis.
    Raises `ValueError` with a question that names the option for what cannot be told.
    """
    if not told.responses:
        named = ", ".join(dict.fromkeys(c.name for one in sets for c in one.responses))
        raise ValueError(
            f"which channel of {file} is the response? --response CHANNEL names it, of {named}."
        )
    spectra = all(_has(one, told.force) for one in sets) if told.force else False
    for one in sets:
        _reference(one, told, file, spectra=spectra)
    amplitude = np.ones(len(sets)) if spectra else _amplitudes(sets, z, told, file)
    parts: list[MeasuredPart] = []
    force, responses, notes = Force(1.0, False, "N"), told.responses, list[str]()
    for k, one in enumerate(sets):
        reference = _reference(one, told, file, spectra=spectra)
        if spectra:
            channel = one.responses[_row(one, told.force, file, "--force")]
            force = force_meaning(told, _si(channel), f"{told.force} of {file}")
            assumed.unit("force_unit", told.force_unit, _si(channel))
            scale = force.factor / channel.calibration if told.force_unit else 1.0
            size = one.values[_row(one, told.force, file, "--force"), reference] * scale
        else:
            channel = one.references[reference]
            if not _si(channel) and not told.force_unit:
                assumed["force_unit"] = Assumption("the file states none of the reference", "N")
            if told.force_unit and _si(channel) not in ("", told.force_unit):
                raise ValueError(
                    f"--force-unit says {told.force_unit}, but the responses of {file} are over "
                    f"{channel.name} in {_si(channel)}, in which --force-amplitude is stated too: "
                    "leave --force-unit out."
                )
            force = force_meaning(told, _si(channel) or "N", f"{channel.name} of {file}")
            size = np.full(len(one.frequency), amplitude[k], dtype=complex)
        rows, filled = [], []
        for number, response in enumerate(told.responses):
            values, found = _velocity(one, response, reference, told, file, assumed, number + 1)
            rows.append(values if spectra else values * amplitude[k])
            filled.append(found)
        responses = tuple(filled)
        velocity = np.stack(rows, axis=1)
        if spectra:
            velocity = velocity * np.exp(-1j * np.angle(size))[:, None]
        good = np.isfinite(velocity).any(axis=1) & (np.abs(size) > 0) & (one.frequency > 0)
        if not good.all():
            notes.append(
                f"{int(np.sum(~good))} lines of set {k + 1} of {file} are left out: no "
                "response, no force, or frequency zero."
            )
        if not good.any():
            raise ValueError(f"set {k + 1} of {file} has no line with force and response.")
        key = z[k] if told.level == "z" else k + 1.0
        parts.append(
            MeasuredPart(
                one.frequency[good],
                np.abs(size[good]),
                velocity[good],
                np.full(int(good.sum()), key),
            )
        )
    if spectra:
        assumed["force_amplitude"] = Assumption(
            "spectra or responses over one reference, of amplitude 1"
        )
    if not told.level:
        assumed["level"] = Assumption("one level a set of responses, in the file's order")
    if told.level not in ("", "z", "order", "force", "runs", "file"):
        raise ValueError(f"--level must be order, z, force or file of {file}, not {told.level!r}.")
    if told.level == "z" and not np.isfinite(z).all():
        raise ValueError(f"--level z: {file} states no value on the z axis: --level order.")
    told = told._replace(responses=responses, level=told.level or "order")
    if spectra and not told.amplitude:
        assumed["amplitude"] = Assumption("nothing is said", "peak")
    if spectra:
        factor = _PEAK[told.amplitude]
        parts = [p._replace(force=p.force * factor, velocity=p.velocity * factor) for p in parts]
    joined = MeasuredPart(
        np.concatenate([p.frequency for p in parts]),
        np.concatenate([p.force for p in parts]),
        np.concatenate([p.velocity for p in parts]),
        np.concatenate([p.key for p in parts if p.key is not None]),
    )
    if told.level in ("force", "runs", "file"):
        joined = joined._replace(key=None)
    return joined, told, force, notes


def _amplitudes(
    sets: Sequence[FrequencyResponses], z: Sequence[float], told: ImportMap, file: str
) -> np.ndarray:
    stated = told.force_amplitude
    if not stated:
        levels = ", ".join(f"{value:g}" for value in z)
        has_z = bool(np.isfinite(z).all())
        way = f"z if they are the z axis' ({levels}), else N" if has_z else "N, one for all or"
        raise ValueError(
            f"which amplitude had the force of {file}, whose responses are over it? "
            f"--force-amplitude {way} one a set ({len(sets)}); `snrmjax modes` takes frequency "
            "responses as they are."
        )
    if stated == ("z",):
        if not (np.isfinite(z).all() and np.all(np.asarray(z) > 0)):
            raise ValueError(
                f"--force-amplitude z needs positive values on the z axis, which {file} lacks: "
                "state N."
            )
        values = np.asarray(z, dtype=float)
    else:
        values = np.asarray([float(one) for one in stated])
    if values.size not in (1, len(sets)):
        raise ValueError(
            f"--force-amplitude must be one for all or one for each of the {len(sets)} sets of "
            f"{file}, but {values.size} are stated."
        )
    return np.broadcast_to(values * _PEAK[told.amplitude], (len(sets),))


def _velocity(
    one: FrequencyResponses,
    told: ResponseMap,
    reference: int,
    whole: ImportMap,
    file: str,
    assumed: Assumptions,
    number: int,
) -> tuple[np.ndarray, ResponseMap]:
    row = _row(one, told.channel, file, "--response")
    channel = one.responses[row]
    known = channel.quantity not in ("unknown", "voltage")
    assumed.unit(f"response {number}.unit", told.unit, channel.unit if known else "")
    if known and told.quantity and told.quantity != channel.quantity:
        raise ValueError(
            f"{told.channel} of {file} is of {channel.quantity}, but --response calls it "
            f"{told.quantity}: which of both is right?"
        )
    quantity, factor, _ = motion_meaning(
        told.quantity, told.unit, _si(channel) if known else "", told.channel
    )
    # A known channel's values are in SI already: its own unit, or the one that is stated.
    values = one.values[row, reference]
    values = values * (factor / channel.calibration if told.unit else 1.0)
    if whole.phase_sign == "lag":
        values = values.conj()
    elif not whole.phase_sign:
        assumed["phase_sign"] = Assumption("phasors are e^(+iwt)", "lead")
    sensor = told.sensor or (UNNAMED_SENSOR[0] if len(whole.responses) == 1 else told.channel)
    if not told.sensor:
        assumed[f"response {number}.sensor"] = Assumption("not stated; --sensor names it")
    as_channel = Channel(told.channel, _motion(quantity))
    turn = velocity_factors([as_channel], [1], one.frequency)[:, 0, 0]
    return values * turn, ResponseMap(told.channel, quantity, told.unit, sensor)


def _motion(quantity: str) -> Quantity:
    known: dict[str, Quantity] = {"velocity": "velocity", "acceleration": "acceleration"}
    return known.get(quantity, "displacement")


def _si(channel: Channel) -> str:
    return channel.si_unit if channel.quantity != "unknown" else ""


def _has(one: FrequencyResponses, name: str) -> bool:
    return name in [channel.name for channel in one.responses]


def _row(one: FrequencyResponses, name: str, file: str, option: str) -> int:
    names = [channel.name for channel in one.responses]
    if name not in names:
        near = near_miss(name, names)
        raise ValueError(
            f"{option} names {name!r}, but {file} has the responses {', '.join(names)}"
            f"{f' (did you mean {near}?)' if near else ''}."
        )
    return names.index(name)


def _reference(one: FrequencyResponses, told: ImportMap, file: str, *, spectra: bool) -> int:
    names = [channel.name for channel in one.references]
    if told.force and not spectra:
        if told.force not in names:
            raise ValueError(
                f"--force names {told.force!r}, but {file} has the references {', '.join(names)} "
                f"and the responses {', '.join(c.name for c in one.responses)}."
            )
        return names.index(told.force)
    if len(names) > 1:
        raise ValueError(
            f"which reference of {file} is the force? --force names it, of {', '.join(names)}."
        )
    return 0
