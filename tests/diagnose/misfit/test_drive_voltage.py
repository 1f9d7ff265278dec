"""Diagnoses of states whose force is known as a drive voltage only."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from truths.balanced_sets import balanced, linear_model, quadratic
from typer.testing import CliRunner

import snrmjax as sj
from snrmjax.cli import app
from snrmjax.io.models import write_model
from snrmjax.io.tables import write_steady_states

GAIN = 0.8  # N/V


def driven(data):
    """The states with the drive voltage of their force."""
    return dataclasses.replace(
        data,
        drive=jnp.asarray(data.force) / GAIN,
        force=jnp.full(data.n_states, jnp.nan),
        force_std=jnp.full(data.n_states, jnp.nan),
    )


def without_phases(data):
    """The states with amplitudes alone."""
    return dataclasses.replace(
        data,
        velocity=np.abs(data.velocity) + 0j,
        phase_std=np.full(data.velocity.shape, np.pi),
    )


def check(found):
    """The damping is identified, with the right gain."""
    assert "quadratic_damping" in found.candidates[0]
    kinds = ("gain_of_drive", "gain_with_effects")
    first, last = (note for note in found.notes if getattr(note, "kind", "") in kinds)
    assert (first.kind, last.kind) == kinds
    assert last["before"] == first["gain"]
    assert last["gain"] == pytest.approx(GAIN, rel=0.03)
    # The states are in newtons now.
    assert np.isfinite(np.asarray(found.data.force)).all()


@pytest.fixture(scope="module")
def of_volts():
    """The diagnosis of states with a drive voltage, by the Python verb."""
    return sj.diagnose_model(linear_model(), driven(balanced(quadratic)))


def test_the_python_verb_takes_a_drive_voltage(of_volts):
    check(of_volts)


def test_a_drive_voltage_without_phases_is_diagnosed():
    """A joint fit needs the phases; without them it recommends the diagnosis."""
    data = without_phases(driven(balanced(quadratic)))
    with pytest.raises(ValueError, match="snrmjax diagnose"):
        sj.fit_jointly(data, linear_model())
    found = sj.diagnose_model(linear_model(), data)
    assert "quadratic_damping" in found.candidates[0]
    assert not found.notes[0]["from_curves"]


def test_command_and_verb_agree(tmp_path, of_volts):
    data, found = driven(balanced(quadratic)), of_volts
    write_steady_states(tmp_path / "driven.csv", data)
    write_model(tmp_path / "linear.toml", linear_model())
    data_and_model = [tmp_path / "driven.csv", "--model", tmp_path / "linear.toml"]
    words = ["diagnose", *data_and_model, "--out", tmp_path / "out", "--no-responses"]
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert written["effects"] == list(found.effects)
    assert written["notes"] == [*map(str, found.notes)]
    for name, (value, std) in found.parameters.items():
        # Rounding in the file.
        assert written["parameters"][name]["value"] == pytest.approx(value, rel=1e-6)
        assert written["parameters"][name]["std"] == pytest.approx(std, rel=1e-6)
