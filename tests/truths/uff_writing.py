"""Universal files of what tests made: functions 58b or 58."""

import re
import tempfile
from pathlib import Path

import numpy as np
import pyuff

from snrmjax.numerics.units import HERTZ, in_unit

_TYPES = {
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


_HEADER_LINES, _LITTLE_ENDIAN, _IEEE = 11, 1, 2
_AXES = ("abscissa", "ordinate", "orddenom", "z_axis")


def write_uff(path, *, recordings=(), responses=(), levels=(), binary=True):
    """Write time records, frequency responses (data sets 58) in SI units.

    `levels` has one number for each of `responses`, their z axis. In text (`binary` False) values
    have twelve digits and uneven abscissae six.
    """
    sets = [fields for record in recordings for fields in _of_recording(record)]
    for one, z in zip(responses, levels or [0.0] * len(responses), strict=True):
        sets += _of_responses(one, float(np.nan_to_num(z)))
    functions = [fields for fields in sets if fields["type"] == 58 and binary]
    others = [fields for fields in sets if not (binary and fields["type"] == 58)]
    with tempfile.TemporaryDirectory() as folder:
        new = Path(folder) / "new.uff"
        pyuff.UFF(str(new)).write_sets([dict(_SI), *others], "add")
        content = new.read_bytes() + b"".join(_binary_function(fields) for fields in functions)
    Path(path).write_bytes(content)


def _of_recording(record):
    """A time record: one function a channel."""
    values = record.values()
    time = record.start_time + np.arange(2) / record.sampling_rate
    common = {
        "func_type": 1,
        "x": time,
        "abscissa_spacing": 1,
        "abscissa_spec_data_type": 17,
        "abscissa_axis_units_lab": "s",
        "orddenom_spec_data_type": 0,
        "ref_node": 0,
        "ref_dir": 0,
    }
    return [
        {**_side(one, "rsp", "ordinate"), "type": 58, "data": row, **common}
        for one, row in zip(record.channels, values, strict=True)
    ]


def _of_responses(one, z):
    """Frequency responses: one function a pair, and its coherence where it is stated."""
    hertz = np.array([in_unit(float(omega), HERTZ) for omega in one.frequency])
    sets = []
    for k, output in enumerate(one.responses):
        for m, given in enumerate(one.references):
            values, coherence = one.values[k, m], one.coherence[k, m]
            if np.isnan(values).all():
                continue
            common = {
                **_side(output, "rsp", "ordinate"),
                **_side(given, "ref", "orddenom"),
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


def _side(one, side, axis):
    """Fields of a channel: place and quantity. Values are written in SI."""
    whole = bool(re.fullmatch(r"[0-9]{1,9}", one.point))
    place = f"{one.point}{one.direction}"
    entity = "NONE" if one.name == place and whole else one.name
    return {
        f"{side}_ent_name": entity,
        f"{side}_node": int(one.point) if whole else 0,
        f"{side}_dir": _CODES[one.direction],
        f"{axis}_spec_data_type": _TYPES[one.quantity],
        f"{axis}_axis_units_lab": one.si_unit or "NONE",
    }


def _binary_function(fields):
    """A data set 58b in double precision of fields as pyuff names them (optional ones absent).

    pyuff writes them too, but leaves a file handle open, states half the bytes of complex values,
    and packs value by value.
    """
    values, x = np.asarray(fields["data"]), np.asarray(fields["x"], dtype=float)
    is_complex, even = np.iscomplexobj(values), bool(fields["abscissa_spacing"])
    columns = [values.real, values.imag] if is_complex else [values]
    if not even:
        columns.insert(0, x)
    payload = np.stack(columns, axis=1).astype("<f8").tobytes()
    first, step = (x[0], x[1] - x[0]) if even else (0.0, 0.0)
    z = fields.get("z_axis_value", 0.0)
    lines = [
        f"{-1:6d}",
        f"{58:6d}b{_LITTLE_ENDIAN:6d}{_IEEE:6d}{_HEADER_LINES:12d}{len(payload):12d}"
        f"{0:6d}{0:6d}{0:12d}{0:12d}",
        *(f"{fields.get(f'id{k}', 'NONE'):<80.80}" for k in range(1, 6)),
        f"{fields['func_type']:5d}{0:10d}{0:5d}{0:10d} {fields['rsp_ent_name']:>10}"
        f"{fields['rsp_node']:10d}{fields['rsp_dir']:4d} {fields.get('ref_ent_name', 'NONE'):>10}"
        f"{fields['ref_node']:10d}{fields['ref_dir']:4d}",
        f"{6 if is_complex else 4:10d}{len(values):10d}{int(even):10d}{first:13.5e}{step:13.5e}"
        f"{z:13.5e}",
    ]
    for axis in _AXES:
        kind = fields.get(f"{axis}_spec_data_type", 0)
        unit = fields.get(f"{axis}_axis_units_lab", "NONE")
        lines.append(f"{kind:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20} {unit:<20}")
    text = "\n".join(lines) + "\n"
    return text.encode("utf-8") + payload + b"    -1\n"
