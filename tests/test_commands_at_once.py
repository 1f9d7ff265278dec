"""Commands answer at once: they import and compile no more than their answer needs."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import snrmjax as sj

MODEL = """name = "two modes"
[[mode]]
frequency_hz = 64.78
damping_ratio = 0.05
shape = { midspan = 12.77433 }
participation = 3341.536
[[mode]]
frequency_hz = 210.0
damping_ratio = 0.01
shape = { midspan = -3.0 }
participation = 500.0
"""

COUNTED = """
import json, sys
import jax
from snrmjax.cli import main
heard = []
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: heard.append(name))
sys.argv[0] = "snrmjax"
try:
    main()
except SystemExit as ended:
    assert not ended.code
print(json.dumps(heard.count("/jax/core/compile/backend_compile_duration")))
"""


def ran(script: str, *words: object, **variables: str) -> str:
    """What a process of its own prints in its last line."""
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, words)],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("files")
    model, data = folder / "model.toml", folder / "data.csv"
    model.write_text(MODEL)
    structure = sj.read_model(model)
    hertz, force = np.tile(np.linspace(62.0, 67.5, 9), 2), np.repeat([1e-5, 2e-5], 9)
    velocity = sj.model.linear_response(structure.modes, 2 * np.pi * hertz, force)[:, 0]
    rows = zip(np.repeat([1, 2], 9), hertz, force, velocity.real, velocity.imag, strict=True)
    lines = ["level,frequency_hz,force_n,velocity_re_m_s,velocity_im_m_s"]
    data.write_text("\n".join(lines + [",".join(map(str, row)) for row in rows]))
    return model, data


@pytest.mark.parametrize("words", [["--help"], ["identify", "--help"], ["study", "run", "--help"]])
def test_help_does_not_import_jax(words):
    script = (
        "import sys\nfrom snrmjax.cli import main\n"
        "try:\n    main()\nexcept SystemExit as ended:\n    assert not ended.code\n"
        "slow = {'jax', 'jaxlib', 'scipy', 'matplotlib', 'pandas', 'xarray', 'zarr', 'equinox'}\n"
        "print(sorted(slow & set(sys.modules)))"
    )
    assert ran(script, *words) == "[]"


@pytest.mark.parametrize("first", ["import snrmjax, jax", "import jax, snrmjax"])
@pytest.mark.parametrize("variable", ["0", "1"])
def test_numbers_are_double_whichever_import_comes_first(first, variable):
    script = f"{first}\nimport jax.numpy as jnp\nprint(jnp.ones(1).dtype, jnp.asarray(0.5).dtype)"
    assert ran(script, JAX_ENABLE_X64=variable) == "float64 float64"


@pytest.mark.long
def test_identify_compiles_few_programs_and_none_a_second_time(files, tmp_path):
    model, data = files
    words = ("identify", data, "--model", model, "--out", tmp_path / "out")
    store = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "store")}
    first, second = (json.loads(ran(COUNTED, *words, **store)) for _ in range(2))
    # Points, their filter, velocities of other modes, loops, indicator; small ones of a solver.
    assert 5 <= first <= 15  # 115 where every operation of the host is a program
    assert second == 0


@pytest.mark.long
def test_a_simulation_compiles_nothing_a_second_time(files, tmp_path):
    words = ("nnm", files[0], "--to-hz", 60, "--harmonics", 1, "--out", tmp_path / "out")
    store = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "store")}
    first, second = (json.loads(ran(COUNTED, *words, **store)) for _ in range(2))
    assert second <= 3 < first
