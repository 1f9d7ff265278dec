from .contents import (
    LaboratoryFile,
    MeasuredShapes,
    NumberTable,
    TextFormat,
    measured_shapes,
    number_table,
)
from .reading import read_laboratory_file

__all__ = [
    "LaboratoryFile",
    "MeasuredShapes",
    "NumberTable",
    "TextFormat",
    "measured_shapes",
    "number_table",
    "read_laboratory_file",
]
