"""On-disk cache of compiled programs for later processes."""

import os
from pathlib import Path

import jax
import platformdirs

from snrmjax.io.programs.program_store import keep_programs, processor_digest

WORTH_KEEPING = 0.05  # seconds of compilation; loading from the cache takes a fifth of that


def use_compilation_cache(folder: str | os.PathLike[str] | None = None) -> None:
    """Cache compiled programs on disk, so that the next process starts without compiling them.

    Arguments: `folder` of the cache; by default the one of the JAX variable
    JAX_COMPILATION_CACHE_DIR, or else the user's cache folder for snrmjax and this kind of
    processor, which the commands use too. Call it before the first simulation. Machines with
    different processors need separate folders. Programs are identified by the package's sources:
    functions and constants replaced at run time are not detected.

    >>> import snrmjax as sj
    >>> sj.use_compilation_cache()  # doctest: +SKIP
    """
    cache_folder = folder or os.environ.get("JAX_COMPILATION_CACHE_DIR") or default_cache_folder()
    jax.config.update("jax_compilation_cache_dir", str(cache_folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH_KEEPING)
    keep_programs(Path(cache_folder) / "programs")


def default_cache_folder() -> Path:
    """The user's folder for programs compiled for this kind of processor."""
    return Path(platformdirs.user_cache_dir("snrmjax")) / processor_digest()
