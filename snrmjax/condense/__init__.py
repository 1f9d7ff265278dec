"""Reduced-order models from finite elements, by implicit condensation.

Static load cases of a geometrically nonlinear finite-element model, each with a combination of
modal forces, give modal displacements; one potential V(q) is fitted to all of them. Motions that
follow the modes statically (above all membrane stretching) are condensed into it.

References: J. J. Hollkamp & R. W. Gordon, J. Sound Vib. 318 (2008) 1139,
doi:10.1016/j.jsv.2008.04.035; R. J. Kuether, B. J. Deaner, J. J. Hollkamp & M. S. Allen,
AIAA J. 53 (2015) 3273, doi:10.2514/1.J053838.
"""

import lazy_loader

from snrmjax.numerics.names import with_retired_names

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = with_retired_names(
    __name__,
    __getattr__,
    {
        "StaticStatus": "snrmjax.condense.elements.statics.StaticStatus",
        "static_solutions": "snrmjax.condense.elements.statics.static_solutions",
    },
)
