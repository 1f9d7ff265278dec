"""Files in and out: tables of steady states and of results, models, joint fits.

Readers are `read_X(path)`, writers `write_X(path, what)`; both take any path that Python takes.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
