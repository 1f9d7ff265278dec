"""Compiled programs kept on disk for later processes."""

import os
from pathlib import Path

import jax
import platformdirs

from snrmjax.io.programs.program_store import keep_programs, processor_digest

WORTH_KEEPING = 0.05  # seconds of compilation: reading a program back takes a fifth of that


def use_compilation_cache(folder: str | os.PathLike[str] | None = None) -> None:
    """Keep compiled programs on disk, so that the next process starts without compiling them.

    Arguments: `folder` to keep them in; None takes the one that JAX's own variable
    JAX_COMPILATION_CACHE_DIR names, or else the user's cache folder for snrmjax and this kind of
    processor, which the commands use too. To be called before the first simulation. Machines with
    different processors need folders of their own. Programs of the package are kept whole, known
    by its sources: functions and constants that are exchanged while Python runs are not seen.

    >>> import snrmjax as sj
    >>> sj.use_compilation_cache()  # doctest: +SKIP
    """
    where = folder or os.environ.get("JAX_COMPILATION_CACHE_DIR") or default_cache_folder()
    jax.config.update("jax_compilation_cache_dir", str(where))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH_KEEPING)
    keep_programs(Path(where) / "programs")


def default_cache_folder() -> Path:
    """The user's folder for programs that were compiled for this kind of processor."""
    return Path(platformdirs.user_cache_dir("snrmjax")) / processor_digest()
