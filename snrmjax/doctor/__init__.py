"""The import doctor: errors of import and of the test, detected before identification.

`check_test` checks tables of steady states, the linear model and time records.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
