"""Other identification methods for natural frequency and damping against amplitude.

One file per method, with its source; each returns a `MethodResult`. `compare_methods` runs all
methods that the data allow, the inverse SNRM included, and compares the results.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
