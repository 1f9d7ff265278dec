"""Read and write files: steady states, results, models and joint fits.

Readers are `read_X(path)`, writers `write_X(path, what)`; both accept any path-like object.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
