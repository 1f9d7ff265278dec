"""snrmjax: nonlinear normal mode backbones and damping from near-resonant steady states."""

import jax

# Before anything else is imported: arrays made earlier would be float32.
jax.config.update("jax_enable_x64", True)
