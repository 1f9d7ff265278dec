from .contents import TextFormat
from .reading import read_laboratory_file

__all__ = ["TextFormat", "read_laboratory_file"]
