"""Reduced-order models from CalculiX: input decks, jobs and results.

A user's deck with its own mesh, sections, materials and supports gives linear modes
(`modes_of_deck`) and geometrically nonlinear static load cases (`run_static_cases`), from which
`snrmjax.condense` fits a reduced model. CalculiX expands its beams and shells into solids.
Reference: G. Dhondt, "The Finite Element Method for Three-Dimensional Thermomechanical
Applications", Wiley 2004, doi:10.1002/0470021217.
"""

import lazy_loader

# The public names are in `__init__.pyi`; each module is imported with its first name.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
