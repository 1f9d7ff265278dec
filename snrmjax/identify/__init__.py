"""From measured steady states to backbone and damping, with error bars."""

import lazy_loader

from snrmjax.numerics.names import with_retired_names

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = with_retired_names(__name__, __getattr__, {"ON_THE_CURVES": "WITHOUT_LEVEL_ERRORS"})
