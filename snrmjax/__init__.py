"""snrmjax: nonlinear normal mode backbones and damping from near-resonant steady states."""

import jax
import lazy_loader

# Before anything else is imported: arrays made earlier would be float32.
jax.config.update("jax_enable_x64", True)

from snrmjax.numerics.result import draw_with  # noqa: E402 - after the setting above

draw_with("snrmjax.report.plots")

# The names are in `__init__.pyi`. Who simulates does not wait for the imports of who identifies.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
