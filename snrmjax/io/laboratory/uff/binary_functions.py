"""Functions as binary data sets 58b.

pyuff writes them too, but leaves a file handle open, states half the bytes of complex values, and
packs value by value. Format: SDRC, "Universal Dataset Number: 58", binary form with 11 text lines.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

_HEADER_LINES, _LITTLE_ENDIAN, _IEEE = 11, 1, 2
_AXES = ("abscissa", "ordinate", "orddenom", "z_axis")


def binary_function(fields: Mapping[str, Any]) -> bytes:
    """A data set 58b in double precision of fields as pyuff names them (optional ones absent)."""
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
