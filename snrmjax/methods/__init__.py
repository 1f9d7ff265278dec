"""Other methods that read natural frequency and damping against amplitude, beside the inverse SNRM.

One file a method, with its source; all answer with a `MethodResult`. `compare_methods` runs those
that a table of steady states allows and sets them side by side.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
