"""A deck condensed by CalculiX: against the clamped beam's closed form, and by the command."""

import sys
from unittest import mock

import numpy as np
import pytest
from matplotlib.figure import Figure

from snrmjax.cli import main
from snrmjax.condense import modal_loads, reduced_model
from snrmjax.io.calculix.reduction import read_deck_source
from snrmjax.io.models import read_model
from snrmjax.report.style import png_bytes

from .conftest import DENSITY, LENGTH, THICKNESS, WIDTH, YOUNG, beam_deck, needs_calculix


def command(*arguments):
    """Run a command; its exit code."""
    with mock.patch.object(sys, "argv", ["snrmjax", *map(str, arguments)]):
        try:
            main()
        except SystemExit as end:
            return end.code
    return 0


CLAMPED = ("1, 1, 6", "21, 1, 6")


@needs_calculix
def test_a_clamped_beam_has_the_cubic_coefficient_of_the_closed_form(write):
    deck = write(beam_deck(elements=10, supports=CLAMPED))
    source = read_deck_source(deck, (1,), force=(11, "z"), sensors={"quarter": (6, "z")})
    loads = modal_loads(source.basis, 0.2 * THICKNESS)
    reduced = reduced_model(source.basis, source.solve(np.asarray(loads.force)))
    structure = source.structure(reduced)
    # von Kármán with the first mode alone: β = E A / (2 L) (∫φ'²)², where L² ∫φ'² = 12.3026 ∫φ².
    area = WIDTH * THICKNESS
    closed = YOUNG * 12.3026**2 / (2 * DENSITY**2 * area * LENGTH**5)
    force = structure.potential.coefficient * np.array([3.0, 4.0])  # of q² and q³
    # What the closed form leaves out, further modes and shear, is some 2 % of it.
    np.testing.assert_allclose(force[1], closed, rtol=0.03)
    size = 0.2 * THICKNESS / float(source.basis.largest[0])
    assert abs(float(force[0])) * size < 1e-4 * float(source.basis.frequency[0]) ** 2  # symmetry
    # Midspan is where the first mode is largest; a quarter along it has 0.5434 of that.
    shapes = np.asarray(structure.modes.mode_shape)[0]
    np.testing.assert_allclose(
        shapes / np.asarray(structure.modes.participation), 0.5434, atol=2e-3
    )
    assert (deck.parent / "deck.jobs").is_dir()
    assert [note.kind for note in source.notes] == ["damping_assumed"]


@needs_calculix
def test_the_command_writes_a_model_of_a_deck(write, tmp_path, capsys):
    steps = "*STEP\n*STATIC\n*CLOAD\n3, 3, 1.\n*END STEP"
    deck = write(beam_deck(elements=4, supports=("1, 1, 6", "9, 1, 6"), steps=steps))
    out = tmp_path / "out"
    dot = png_bytes(Figure(figsize=(1, 1)))
    with mock.patch.object(Figure, "savefig", lambda _, buffer, **__: buffer.write(dot)):
        assert command("rom", "--calculix", deck, "--modes", 1, "--no-study", "--out", out) == 0
    captured = capsys.readouterr()
    words = " ".join((captured.out + captured.err).split())
    assert "driven and observed at node 5 in z" in words
    assert "left out (*CLOAD)" in words
    assert "no step of the deck has NLGEOM" in words
    assert "`*STEP, NLGEOM, INC=1000` instead of the deck's steps" in words
    model = read_model(out / "model.toml")
    assert model.modes.sensors == ("node 5 z",)
    assert (out / "report.html").is_file()


@pytest.mark.parametrize(
    ("text", "modes", "message"),
    [
        (beam_deck(), None, "`--modes` must be different mode numbers"),
        (beam_deck(), "1,1", "must be different mode numbers"),
        (beam_deck(supports=("99, 1, 6",)), "1", "support is at node 99"),
        (beam_deck(), "1", "ccx is not on the search path: install it"),
        ("", "1", "no *NODE block"),
    ],
    ids=["no modes", "twice", "missing node", "no CalculiX", "empty"],
)
def test_the_command_refuses_in_one_sentence(
    write, tmp_path, monkeypatch, capsys, text, modes, message
):
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    deck, out = write(text), tmp_path / "out"
    chosen = [] if modes is None else ["--modes", modes]
    assert command("rom", "--calculix", deck, *chosen, "--out", out) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deck.inp"]


@needs_calculix
def test_a_mechanism_leaves_no_folder_of_jobs(write, tmp_path, capsys):
    deck, out = write(beam_deck(elements=2, supports=())), tmp_path / "out"
    assert command("rom", "--calculix", deck, "--modes", 1, "--out", out) == 2
    assert "the structure is a mechanism or not supported" in " ".join(
        capsys.readouterr().err.split()
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deck.inp"]
