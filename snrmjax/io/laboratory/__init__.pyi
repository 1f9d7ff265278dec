from .contents import (
    LaboratoryFile,
    NumberTable,
    TextFormat,
    number_table,
)
from .reading import read_laboratory_file

__all__ = [
    "LaboratoryFile",
    "NumberTable",
    "TextFormat",
    "number_table",
    "read_laboratory_file",
]
