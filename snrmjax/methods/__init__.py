"""Other identification methods for natural frequency and damping against amplitude.

One file per method, with its source; each returns a `MethodResult`. `compare_methods` runs all
methods that the data allow, the inverse SNRM included, and compares the results.
"""

import lazy_loader

from snrmjax.numerics.names import with_retired_names

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
_FORMER = {
    "decay_of_mode": "resonant_decay",
    "fit_restoring_force": "restoring_force",
    "fit_state_space": "state_space_fit",
    "restoring_force_of_mode": "recorded_decays",
    "ssm_of_mode": "recorded_decays",
}
__getattr__ = with_retired_names(
    __name__,
    __getattr__,
    {name: f"{__name__}.records.{module}.{name}" for name, module in _FORMER.items()},
)
