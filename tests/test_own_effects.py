"""Effects of a user's own that commands load from a Python file."""

import json
import sys
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import snrmjax as sj
from snrmjax.cli import main
from snrmjax.io.programs import effect_files
from snrmjax.model import effects

OMEGA, SHAPE, GAMMA = 2 * np.pi * 50.0, 2.0, 1e14
QUINTIC = """
import jax
import snrmjax as sj
from power import POWER  # beside this file

class OwnQuintic(sj.model.AbstractMemoryless):
    kind = "own_quintic"
    coefficient: jax.Array = sj.model.parameter("1/(kg² m⁴ s²)", "own quintic stiffness")

    def force(self, displacement, velocity):
        return self.coefficient * displacement**POWER
"""
DAMPING = """
import jax
import snrmjax as sj

@sj.model.register_effect
class RootDamping(sj.model.AbstractMemoryless):
    kind = "own_root_damping"
    coefficient: jax.Array = sj.model.parameter("(kg^1/2 m/s)^(1/2)/s", "root damping")

    def force(self, displacement, velocity):
        return self.coefficient * velocity / (velocity**2 + 1e-12) ** 0.25
"""
MODEL = """
[[mode]]
frequency_hz = 50.0
damping_ratio = 0.005
shape = { tip = 2.0 }
participation = 1.0
"""
EFFECT = f'[[effect]]\nkind = "own_quintic"\ncoefficient = {GAMMA}\n'
STUDY = """model = "quintic.toml"
compute = "nnm"
to_hz = 55
harmonics = 9
members_a_chunk = 1
vary = [{ parameter = "own_quintic.coefficient", values = [1e14, 2e14] }]
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder to work in; what is loaded there is forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(effect_files, "_loaded", {})
    (tmp_path / "model.toml").write_text(MODEL)
    (tmp_path / "quintic.toml").write_text(MODEL + EFFECT)
    (tmp_path / "own.py").write_text(QUINTIC)
    (tmp_path / "power.py").write_text("POWER = 5\n")
    (tmp_path / "damping.py").write_text(DAMPING)
    known = {**effects.EFFECTS}
    yield tmp_path
    for kind in {*effects.EFFECTS} - {*known}:
        del effects.EFFECTS[kind]
    sys.modules.pop("power", None)


def run(*words):
    with (
        mock.patch.object(sys, "argv", ["snrmjax", *map(str, words)]),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return ended.value.code or 0


def exact_frequency(peak_velocity, gamma=GAMMA):
    """Of q̈ + ω²q + γq⁵ = 0 in Hz, by SciPy's quadrature, at a largest velocity of the sensor."""

    def energy(q):
        return 0.5 * OMEGA**2 * q**2 + gamma * q**6 / 6

    largest = brentq(lambda q: energy(q) - 0.5 * (peak_velocity / SHAPE) ** 2, 0.0, 1.0)

    def slowness(angle):  # dt/dθ with q = A sin θ, regular at its ends
        q = largest * np.sin(angle)
        over = 0.5 * OMEGA**2 + gamma * (largest**4 + largest**2 * q**2 + q**4) / 6
        return 1 / np.sqrt(2 * over)

    quarter, _ = quad(slowness, 0.0, np.pi / 2, epsabs=0, epsrel=1e-11)
    return 1 / (4 * quarter)


def test_the_backbone_of_an_own_spring_is_that_of_its_potential(folder):
    assert run("nnm", "quintic.toml", "--to-hz", 55, "--effects", "own.py", "--out", "out") == 0
    mode = pd.read_csv(folder / "out" / "nnm.csv")
    assert mode.frequency_hz.iloc[-1] > 54.9
    some = mode.iloc[:: max(len(mode) // 6, 1)]
    exact = [exact_frequency(velocity) for velocity in some.velocity_peak_m_s]
    # Nine harmonics; peaks are read from samples of a period.
    np.testing.assert_allclose(some.frequency_hz, exact, rtol=1e-5)


def test_a_study_takes_an_own_effect_to_its_processes(folder, capsys):
    (folder / "study.toml").write_text(STUDY)
    words = "study", "run", "study.toml", "--out", "s.zarr", "--effects", "own.py"
    assert run(*words, "--processes", 2) == 0
    data = sj.study.open_study("s.zarr")
    speed = data.end_velocity_m_s.values
    # Of one frequency, amplitudes go with γ^(-1/4): so do velocities.
    np.testing.assert_allclose(speed[1] / speed[0], 2**-0.25, rtol=1e-4)
    (folder / "power.py").write_text("POWER = 5  # as it was\n")
    assert run(*words) == 0
    assert "nothing was left to compute" in capsys.readouterr().err
    assert run(*words[:-2], "--out", "t.zarr", "--scheduler", "tcp://x:1", *words[-2:]) == 2
    assert "a Dask cluster's workers do not load" in capsys.readouterr().err


def test_a_diagnosis_looks_for_an_own_effect_and_a_simulation_has_it(folder):
    effect_files.load_effects("damping.py")
    modes = sj.model.linear_modes([OMEGA], [0.005], [[SHAPE]], [1.0], sensors=("tip",))
    own = sj.model.make_effect("own_root_damping", {"coefficient": 0.6})
    truth = sj.model.structure(modes, effects=own)
    errors = sj.simulate.Recording(sj.simulate.MeasurementErrors(amplitude=0.005, phase=0.005))
    test = sj.phase_resonance_test(
        *(truth, [0.05, 0.2, 0.8], 0.9 * OMEGA, 1.1 * OMEGA), points_per_level=8, recording=errors
    )
    sj.io.write_steady_states("measured.csv", test.steady_states)
    words = "measured.csv", "--model", "model.toml", "--effects", "damping.py", "--no-responses"
    assert run("diagnose", *words, "--effects", "own.py", "--out", "out") == 0
    found = json.loads((folder / "out" / "diagnosis.json").read_text())
    assert found["effects"] == ["own_root_damping"]
    # Whoever brings an effect sees it fitted, even where its start promises nothing.
    tried = [one["effect"] for one in found["tried"]]
    assert {"own_root_damping", "own_quintic"} <= {*tried}
    one = found["parameters"]["own_root_damping.coefficient"]
    assert abs(one["value"] - 0.6) < 4 * one["std"]
    # What it wrote is a model for other commands.
    words = "out/model.toml", "--force", 0.2, "--from-hz", 45, "--to-hz", 55, "--harmonics", 3
    assert run("simulate", *words, "--effects", "damping.py", "--out", "simulated") == 0
    curve = pd.read_csv(folder / "simulated" / "response.csv")
    # At resonance the force balances the damping's fundamental, to that of the third harmonic.
    fraction, _ = quad(lambda angle: np.sin(angle) ** 1.5, 0.0, np.pi)
    root = one["value"] * 2 * fraction / np.pi
    rate = brentq(lambda v: 0.01 * OMEGA * v + root * np.sqrt(v) - 0.2, 0.0, 1.0)
    speed = np.hypot(curve.velocity_h1_re_m_s, curve.velocity_h1_im_m_s)
    assert speed.max() == pytest.approx(SHAPE * rate, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "own.py does not exist"),
        ("x = (", "own.py cannot be loaded: SyntaxError"),
        ("1 / 0", "own.py cannot be loaded: ZeroDivisionError: division by zero."),
        ("raise SystemExit(3)", "own.py cannot be loaded: SystemExit: 3."),
        ("import snrmjax", "own.py defines no effect: a class with a `kind`"),
        (QUINTIC.replace("own_quintic", "cubic_stiffness"), "kind 'cubic_stiffness' is already"),
    ],
)
def test_a_file_that_is_none_of_effects_is_refused_in_a_sentence(folder, capsys, text, words):
    (folder / "own.py").unlink()
    if text is not None:
        (folder / "own.py").write_text(text)
    assert run("nnm", "quintic.toml", "--to-hz", 55, "--effects", "own.py", "--out", "out") == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.partition("read more: ")[0].count("\n") == 1
    assert not (folder / "out").exists()


def test_only_python_files_have_effects(folder, capsys):
    words = "nnm", "model.toml", "--to-hz", 55, "--effects", "model.toml", "--out", "out"
    assert run(*words) == 2
    assert "model.toml is no Python file" in capsys.readouterr().err
