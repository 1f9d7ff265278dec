"""Compiled programs kept on disk for later processes."""

import os

import jax
import platformdirs

_WORTH_KEEPING = 0.05  # seconds of compilation: reading a program back takes a fifth of that


def use_compilation_cache(folder: str | os.PathLike[str] | None = None) -> None:
    """Keep compiled programs on disk, so that the next process starts without compiling them.

    Arguments: `folder` to keep them in; None takes the one that JAX's own variable
    JAX_COMPILATION_CACHE_DIR names, or else the user's cache folder for snrmjax, which the
    commands use too. To be called before the first simulation. Machines with different processors
    need folders of their own.

    >>> import snrmjax as sj
    >>> sj.use_compilation_cache()  # doctest: +SKIP
    """
    where = folder or os.environ.get("JAX_COMPILATION_CACHE_DIR")
    jax.config.update(
        "jax_compilation_cache_dir", str(where or platformdirs.user_cache_dir("snrmjax"))
    )
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING)
