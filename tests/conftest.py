"""One way of compiling and one store of compiled programs for all that the tests start."""

import ctypes
import gc
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import pytest

_STORE = "JAX_COMPILATION_CACHE_DIR"
_LEAST_TIME = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
_LEAST_ROOM = 3 * 2**30  # bytes that a worker may hold before it forgets its programs
_QUICK = " ".join(
    (
        # Two thirds of the time, and by one thread: each worker has one core.
        "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1",
        # Another fifth: loops within loops are copied for every look into how often they turn and
        # what does not change in them, and what is known of memory is for optimisations alone.
        # A tenth: operations are not divided among threads.
        "--xla_disable_hlo_passes=while-loop-invariant-code-motion,while-loop-trip-count-annotator,"
        "cpu-parallel-task-assigner",
        "--xla_llvm_enable_alias_scope_metadata=false --xla_llvm_enable_noalias_metadata=false",
        "--xla_llvm_enable_invariant_load_metadata=false",
    )
)


def _knows_quick() -> bool:
    """Whether this version of XLA has the flags: it ends a process that sets one it has not."""
    tried = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"],
        env=os.environ | {"XLA_FLAGS": _QUICK, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        check=False,
    )
    return tried.returncode == 0


# Before JAX is imported, which a folder's own conftest does, and before workers, which inherit the
# environment, are started. Compiling is most of the time: hardly a program of a test runs long
# enough to be worth optimising.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # further threads wait for work at full speed
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = _QUICK if _knows_quick() else ""
# Tracing makes many small objects that live: looking for garbage less often saves a twentieth.
gc.set_threshold(200_000, 50, 100)


def pytest_configure(config: pytest.Config) -> None:
    """Before workers are started."""
    if _STORE in os.environ:
        return
    os.environ[_STORE], os.environ[_LEAST_TIME] = _store(config), "0.1"
    if "jax" in sys.modules:  # where a single folder is run
        import jax

        jax.config.update("jax_compilation_cache_dir", os.environ[_STORE])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _store(config: pytest.Config) -> str:
    """Beside pytest's own cache, kept between runs, one for each version of the compiler."""
    if not hasattr(config, "cache"):  # pytest was asked to keep nothing
        config.snrmjax_store = tempfile.mkdtemp(prefix="snrmjax-tests-")
        return config.snrmjax_store
    own = config.cache.mkdir(f"programs-jaxlib-{version('jaxlib')}")
    for other in own.parent.glob("programs-jaxlib-*"):
        if other != own:
            shutil.rmtree(other, ignore_errors=True)
    return str(own)


def pytest_unconfigure(config: pytest.Config) -> None:
    if hasattr(config, "snrmjax_store"):
        shutil.rmtree(config.snrmjax_store, ignore_errors=True)
        del os.environ[_STORE]


@pytest.fixture(autouse=True, scope="session")
def no_kept_programs():
    """Tests exchange functions of the package, of which programs that are kept know nothing."""
    from snrmjax.numerics.compiled import keep_no_programs

    keep_no_programs()


@pytest.fixture(scope="module")
def optimised():
    """Programs as users have them, for tests of which they run longer than they take to compile."""
    import jax

    name = "jax_disable_most_optimizations"
    before = jax.config.values[name]
    jax.config.update(name, False)
    yield
    jax.config.update(name, before)


@pytest.fixture(autouse=True, scope="module")
def bounded_memory():
    """The programs of all modules together would fill gigabytes; the store has them on disk."""
    yield
    if _memory() > _room():
        import jax

        jax.clear_caches()
        _give_back()


def _room() -> float:
    """Bytes of a worker, beyond which it forgets its programs: half of the memory for all workers.

    To forget takes seconds, and what is used again is traced again.
    """
    if not hasattr(os, "sysconf"):
        return _LEAST_ROOM
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return max(_LEAST_ROOM, whole / 2 / workers)


def _memory() -> float:
    """Bytes that this process holds; without end where that cannot be read."""
    status = Path("/proc/self/statm")
    if not status.exists():
        return float("inf")
    return int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _give_back() -> None:
    """To the system, what was freed: else all later modules would find no room, and forget too."""
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc has it
        if trim is not None:
            trim(0)


def pytest_collection_modifyitems(items):
    if not os.environ.get("SNRMJAX_LONG_TESTS"):
        skip = pytest.mark.skip(reason="takes long: set SNRMJAX_LONG_TESTS=1")
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(skip)
    # What runs longest starts first: no worker then waits at the end for the other's last file.
    items.sort(key=lambda item: _turn(_unit(item.nodeid)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Files go to workers whole; those of joint fits, which share programs, all to one."""
    from xdist.scheduler import LoadFileScheduling

    # By itself it starts with the files of most tests, which are not those that take longest.
    config.option.loadscopereorder = False

    class ByPrograms(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _unit(nodeid)

    return ByPrograms(config, log)


def _unit(nodeid: str) -> str:
    """What a worker takes at once: a file, or all that compile the programs of joint fits."""
    file = nodeid.split("::")[0].removeprefix("tests/")
    joint = (
        *("identify/joint", "identify/inference", "identify/curves", "report/test_joint"),
        *("report/test_html", "report/test_figures", "test_cli.py", "test_readme.py"),
    )
    return "joint fits" if file.startswith(joint) else file


def _turn(unit: str) -> int:
    """When a unit starts: the longest first, after them what simulates, searches or starts others.

    All else takes seconds a file and fills what is left.
    """
    turns = ("joint fits", "diagnose/test_diagnosis.py", "test_help.py", "test_notebooks.py")
    later = ("simulate/", "diagnose/", "doctor/", "pipelines/", "identify/")
    return next(
        (turn for turn, first in enumerate((*turns, *later)) if unit.startswith(first)),
        len(turns) + len(later),
    )


@pytest.fixture
def compilations():
    """The seconds of everything that JAX compiles from now on."""
    import jax

    found = []

    def listen(event: str, seconds: float, **_: object) -> None:
        if event.endswith("backend_compile_duration"):
            found.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)
