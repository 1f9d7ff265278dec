"""Writing universal files: functions 58b or 58, mode shapes 55."""

import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.files import FilePath, file_name, write_atomically
from snrmjax.io.laboratory.contents import MeasuredShapes
from snrmjax.io.laboratory.libraries import MOST_HELD, library
from snrmjax.io.laboratory.uff.abscissa import exact_line
from snrmjax.io.laboratory.uff.binary_functions import binary_function
from snrmjax.io.units import HERTZ, in_unit
from snrmjax.measure.recordings.channels import Channel, Quantity
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording

_TYPES: dict[Quantity, int] = {
    "displacement": 8,
    "velocity": 11,
    "acceleration": 12,
    "force": 13,
    "voltage": 1,
    "unknown": 0,
}
_CODES = {"": 0, "+x": 1, "+y": 2, "+z": 3, "+rx": 4, "+ry": 5, "+rz": 6} | {
    "-x": -1,
    "-y": -2,
    "-z": -3,
    "-rx": -4,
    "-ry": -5,
    "-rz": -6,
}
_SI = {
    "type": 164,
    "units_code": 1,
    "units_description": "SI",
    "temp_mode": 1,
    "length": 1.0,
    "force": 1.0,
    "temp": 1.0,
    "temp_offset": 0.0,
}


def write_uff(
    path: FilePath,
    *,
    recordings: Sequence[TimeRecording] = (),
    responses: Sequence[FrequencyResponses] = (),
    levels: Sequence[float] = (),
    shapes: Sequence[MeasuredShapes] = (),
    binary: bool = True,
) -> None:
    """Write time records, frequency responses (data sets 58) and mode shapes (55) in SI units.

    Arguments: `levels` has one number for each of `responses`, their z axis; `binary` writes 58b,
    in which values come back bit for bit. In text (`binary` False) values have twelve digits and
    uneven abscissae six. Frequencies are written value by value; the start and rate of a record,
    for which the format has six digits, stand in full in the fourth line of identification, which
    `read_laboratory_file` reads. Shapes have six digits.
    Raises `ValueError` for nothing to write, a record of more than 2^24 numbers, values that are
    missing in part of a frequency response, names longer than ten letters, and directions that the
    format does not have.
    """
    pyuff = library("pyuff", "writing universal files")
    file = file_name(path)
    sets: list[dict[str, Any]] = []
    for record in recordings:
        sets += _of_recording(record, file)
    zs = [0.0] * len(responses) if not levels else list(levels)
    for one, z in zip(responses, zs, strict=True):
        sets += _of_responses(one, float(np.nan_to_num(z)), file)
    for modes in shapes:
        sets += _of_shapes(modes, file)
    if not sets:
        raise ValueError(f"there is nothing to write to {file}.")
    functions = [fields for fields in sets if fields["type"] == 58 and binary]
    others = [fields for fields in sets if not (binary and fields["type"] == 58)]
    with tempfile.TemporaryDirectory() as folder:
        new = Path(folder) / "new.uff"
        pyuff.UFF(str(new)).write_sets([dict(_SI), *others], "add")
        content = new.read_bytes() + b"".join(binary_function(fields) for fields in functions)
    write_atomically(path, content)


def _of_recording(record: TimeRecording, file: str) -> list[dict[str, Any]]:
    """A time record: one function a channel."""
    if record.n_samples * len(record.channels) > MOST_HELD or record.n_samples < 2:
        raise ValueError(
            f"a record in {file} must have 2 samples and at most {MOST_HELD} numbers, but has "
            f"{record.n_samples} of {len(record.channels)} channels: write it as netCDF."
        )
    values = record.values()
    if not np.isfinite(values).all():
        raise ValueError(f"a record in {file} must be finite: pyuff writes 0 for NaN.")
    time = record.start_time + np.arange(2) / record.sampling_rate
    common = {
        "func_type": 1,
        "x": time,
        "abscissa_spacing": 1,
        "id4": exact_line(record.start_time, record.sampling_rate),
        "abscissa_spec_data_type": 17,
        "abscissa_axis_units_lab": "s",
        "orddenom_spec_data_type": 0,
        "ref_node": 0,
        "ref_dir": 0,
    }
    return [
        {**_side(one, "rsp", "ordinate", k + 1), "type": 58, "data": row, **common}
        for k, (one, row) in enumerate(zip(record.channels, values, strict=True))
    ]


def _of_responses(one: FrequencyResponses, z: float, file: str) -> list[dict[str, Any]]:
    """Frequency responses: one function a pair, and its coherence where it is stated."""
    hertz = np.array([in_unit(float(omega), HERTZ) for omega in one.frequency])
    if hertz.size < 2:
        raise ValueError(f"a frequency response in {file} must have two frequencies at least.")
    sets = []
    for k, output in enumerate(one.responses):
        for m, given in enumerate(one.references):
            values, coherence = one.values[k, m], one.coherence[k, m]
            if np.isnan(values).all():
                continue
            if not np.isfinite(values).all():
                raise ValueError(
                    f"the response {output.name} over {given.name} is missing at some frequencies, "
                    f"which {file} could not say."
                )
            common = {
                **_side(output, "rsp", "ordinate", k + 1),
                **_side(given, "ref", "orddenom", m + 1),
                "type": 58,
                "id1": one.name[:80] or "NONE",
                "x": hertz,
                "abscissa_spacing": 0,  # even would leave six digits of start and step
                "abscissa_spec_data_type": 18,
                "abscissa_axis_units_lab": "Hz",
                "z_axis_value": z,
            }
            sets.append({**common, "func_type": 4, "data": values})
            if np.isfinite(coherence).all():
                sets.append({**common, "func_type": 6, "data": coherence})
    return sets


def _side(one: Channel, side: str, axis: str, number: int) -> dict[str, Any]:
    """Fields of a channel: place and quantity. Values are written in SI."""
    if one.direction not in _CODES:
        raise ValueError(
            f"the direction of channel {one.name} must be one of {', '.join(_CODES)}, but is "
            f"{one.direction!r}."
        )
    whole = bool(re.fullmatch(r"[0-9]{1,9}", one.point))
    place = f"{one.point}{one.direction}"
    entity = "NONE" if one.name == place and whole else one.name
    if len(entity) > 10 or not entity.isascii() or not entity.isprintable():
        raise ValueError(
            f"universal files have ten letters for a channel's name, but one is {one.name!r}."
        )
    fields: dict[str, Any] = {
        f"{side}_ent_name": entity,
        f"{side}_node": int(one.point) if whole else 0,
        f"{side}_dir": _CODES[one.direction],
        f"{axis}_spec_data_type": _TYPES[one.quantity],
        f"{axis}_axis_units_lab": one.si_unit or "NONE",
    }
    return fields


def _of_shapes(modes: MeasuredShapes, file: str) -> list[dict[str, Any]]:
    """Mode shapes: one data set a mode, real (normal mode) or complex."""
    points = list(dict.fromkeys(modes.points))
    axes = ["+x", "+y", "+z", "+rx", "+ry", "+rz"]
    if not all(re.fullmatch(r"[0-9]{1,9}", point) for point in points):
        raise ValueError(f"points of shapes in {file} must be whole numbers, but are {points[:3]}.")
    ways = [way.replace("-", "+") if way else "+x" for way in modes.directions]
    if not set(ways) <= set(axes) or len(set(zip(modes.points, ways, strict=True))) < len(ways):
        raise ValueError(f"directions of shapes in {file} must be along x, y, z, once at a point.")
    rotated, real = any("r" in way for way in ways), modes.is_real
    if rotated and not real:
        raise ValueError(f"complex shapes in {file} must have no rotations: the format's limit.")
    kinds = np.float64 if real else np.complex128
    sets = []
    for k, shape in enumerate(modes.shapes):
        every = np.zeros((6 if rotated else 3, len(points)), dtype=kinds)
        for value, point, way, said in zip(
            shape, modes.points, ways, modes.directions, strict=True
        ):
            sign = -1 if said.startswith("-") else 1
            every[axes.index(way), points.index(point)] = sign * (value.real if real else value)
        sets.append(
            {
                "type": 55,
                "data_ch": 3 if rotated else 2,
                "spec_data_type": 8,
                "load_case": 0,
                "mode_n": k + 1,
                "node_nums": np.array([int(point) for point in points]),
                **{f"r{axis + 1}": row for axis, row in enumerate(every)},
                **_modal_fields(modes, k),
            }
        )
    return sets


def _modal_fields(modes: MeasuredShapes, k: int) -> Mapping[str, Any]:
    """Frequency and damping of a mode, as those of a normal mode or as an eigenvalue."""
    omega, ratio = float(modes.frequency[k]), float(np.nan_to_num(modes.damping_ratio[k]))
    if modes.is_real:
        return {
            "analysis_type": 2,
            "freq": in_unit(omega, HERTZ),
            "modal_m": float(np.nan_to_num(modes.modal_mass[k])),
            "modal_damp_vis": ratio,
            "modal_damp_his": 0.0,
        }
    return {"analysis_type": 3, "eig": complex(-ratio * omega, omega * np.sqrt(1 - ratio**2))}
