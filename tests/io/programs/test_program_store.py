"""Programs stored on disk, identified by all of their inputs and nothing else."""

import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.io.programs import program_store
from snrmjax.io.programs.program_store import key_of, version_of
from snrmjax.model.modes import linear_response
from snrmjax.model.structures import Structure, linear_terms_of
from snrmjax.numerics.compiled import NotKept

linear_terms = linear_terms_of.__wrapped__
response = linear_response.__wrapped__


def beam(**changed) -> Structure:
    modes = sj.model.linear_modes([500.0, 900.0], [0.01, 0.02], [[2.0, 1.0]], [3.0, 1.0], **changed)
    return sj.model.structure(modes, sj.model.polynomial_potential({"1111": 1e6, "1122": 1e6}, 2))


class TestKeys:
    def test_numbers_are_arguments(self):
        one, other = beam(), eqx.tree_at(lambda m: m.modes.damping_ratio, beam(), jnp.ones(2))
        assert key_of(linear_terms, one) == key_of(linear_terms, other)
        assert key_of(response, (one.modes, 1.0)) == key_of(response, (one.modes, 2.0))

    def test_everything_else_has_a_key_of_its_own(self):
        model = beam()
        keys = [
            key_of(linear_terms, model),
            key_of(response, model),
            key_of(linear_terms, model, (True,)),
            key_of(linear_terms, beam(mode_of_interest=1)),  # static fields of the modes
            key_of(linear_terms, beam(sensors=("tip",))),
            key_of(linear_terms, model.modes),
            *(key_of(linear_terms, [model, more]) for more in (1, 2, True, None, "1", (1,), [1])),
            key_of(linear_terms, [model, np.ones(2)]),
            key_of(linear_terms, [model, np.ones(3)]),
            key_of(linear_terms, [model, np.ones(2, int)]),
            key_of(linear_terms, [model, {"a": 1}]),
            key_of(linear_terms, [model, {"b": 1}]),
        ]
        assert len(set(keys)) == len(keys)

    def test_a_static_number_is_part_of_the_key(self):
        key = program_store._argument_key
        assert key(0.5) == key(0.25)
        assert key(0.5, fixed=True) != key(0.25, fixed=True)
        with pytest.raises(NotKept):
            key(np.ones(2), fixed=True)  # the key would have only shape and type

    def test_code_of_others_is_not_kept(self):
        class Own(eqx.Module):
            value: float

        def inner(x):
            return x

        for function, argument in (
            (linear_terms, Own(1.0)),
            (linear_terms, inner),
            (linear_terms, partial(inner)),
            (linear_terms, np.sin),
            (linear_terms, {1, 2}),
            (inner, 1.0),
            (lambda x: x, 1.0),
            (beam, 1.0),
        ):
            with pytest.raises(NotKept):
                key_of(function, argument)


def test_a_changed_source_is_another_version(tmp_path):
    (tmp_path / "room").mkdir()
    for name in ("one.py", "room/two.py"):
        (tmp_path / name).write_text(f"NAME = {name!r}")
    first = version_of(tmp_path)
    assert version_of(tmp_path) == first
    (tmp_path / "room" / "two.py").write_text("NAME = 'room/two,py'")
    changed = version_of(tmp_path)
    (tmp_path / "room" / "two.py").rename(tmp_path / "two.py")
    assert len({first, changed, version_of(tmp_path)}) == 3


def test_old_versions_make_room(tmp_path):
    for k in range(5):
        (tmp_path / str(k)).mkdir()
        os.utime(tmp_path / str(k), (k, k))
    program_store._drop_old(tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["3", "4"]
    program_store._drop_old(tmp_path / "none")  # nothing is created


SCRIPT = """
import json, sys
import jax, numpy as np, snrmjax as sj
from snrmjax.model.modes import linear_response
from snrmjax.model.structures import equilibria
heard = []
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: heard.append(name))
sj.use_compilation_cache(sys.argv[1])
if "registered" in sys.argv:
    @sj.model.register_effect
    class Own(sj.model.AbstractMemoryless):
        kind = "own"
        description = "Own."
        coefficient: jax.Array = sj.model.parameter("1/s", "own")

        def force(self, displacement, velocity):
            return self.coefficient * velocity

modes = sj.model.linear_modes([500.0, 900.0], [0.01, 0.02], [[2.0, 1.0]], [3.0, 1.0])
potential = sj.model.polynomial_potential({"1111": 1e12, "111": -4e8, "1122": 1e12}, 2)
rest = equilibria(sj.model.structure(modes, potential), n_starts=20)  # calls LAPACK
answer = linear_response(modes, np.linspace(400.0, 600.0, 7), np.ones(7))
slope = jax.grad(lambda f: abs(linear_response(modes, 450.0, f)[0]))(2.0)
numbers = [*np.ravel([e.displacement for e in rest]), *np.ravel(answer).view(float), slope]
print(json.dumps([[float(n).hex() for n in numbers], heard.count(sys.argv[2])]))
"""


def ran(folder: Path, *further: str) -> tuple[list[str], int]:
    """The digits of a process, and its number of compiled programs."""
    done = subprocess.run(
        [
            *(sys.executable, "-c", SCRIPT, folder),
            *("/jax/core/compile/backend_compile_duration", *further),
        ],
        env={k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return tuple(json.loads(done.stdout.splitlines()[-1]))


def test_the_second_process_has_the_digits_of_the_first_and_damaged_files_are_ignored(tmp_path):
    digits, compiled = ran(tmp_path)
    programs = [file for file in (tmp_path / "programs").rglob("*") if file.is_file()]
    assert len(programs) == 4  # terms, Newton's method with LAPACK, energy, response
    again, left = ran(tmp_path)
    assert again == digits
    assert compiled - left >= len(programs)
    whole = [file.read_bytes() for file in programs]
    for file, content in zip(programs, whole, strict=True):
        file.write_bytes(content[: len(content) // 2])
    programs[0].write_bytes(b"")
    programs[1].write_bytes(bytes(1000))
    repaired, once_more = ran(tmp_path)
    assert repaired == digits
    assert once_more - left >= len(programs)
    assert all(file.stat().st_size > 1000 for file in programs)  # and rewritten


def test_with_an_effect_of_a_user_nothing_is_kept(tmp_path):
    digits, _ = ran(tmp_path, "registered")
    assert not [file for file in (tmp_path / "programs").rglob("*") if file.is_file()]
    assert len(digits) > 10


@pytest.mark.long
def test_a_folder_that_cannot_be_written_does_not_matter(tmp_path):
    (tmp_path / "programs").write_text("a file in its place")
    digits, _ = ran(tmp_path)
    shutil.rmtree(tmp_path)
    assert ran(tmp_path)[0] == digits


def test_programs_are_of_the_sources_of_the_whole_package():
    """A change of an equation must not find the program of the old one."""
    assert (program_store._SOURCES / "identify" / "pointwise" / "snrm.py").is_file()
    assert Path(sj.__file__).resolve().parent == program_store._SOURCES
