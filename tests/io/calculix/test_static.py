"""Static load cases by CalculiX against beam theory; statuses and resuming, also without it."""

import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.condense.load_cases import ReductionBasis
from snrmjax.io.calculix.deck import read_deck
from snrmjax.io.calculix.modes import DeckModes, modes_of_deck
from snrmjax.io.calculix.static import run_static_cases

from .conftest import LENGTH, THICKNESS, WIDTH, YOUNG, beam_deck, needs_calculix

INERTIA = WIDTH * THICKNESS**3 / 12


@needs_calculix
def test_tip_deflection_and_energy_of_a_cantilever(write, tmp_path):
    # A basis of one "mode": the tip's deflection, so that f is a tip force (N) and q in metres.
    deck = read_deck(write(beam_deck(elements=8)))
    tip = np.zeros((3 * len(deck.nodes), 1))
    tip[3 * deck.node_index(deck.nearest_node((LENGTH, 0.0, 0.0))) + 2] = 1.0
    basis = ReductionBasis(jnp.ones(1), jnp.asarray(tip), jnp.asarray(tip.T), (1,))
    modes = DeckModes(basis, deck, np.ones(1), np.zeros((1, 1)))
    stiffness = 3 * YOUNG * INERTIA / LENGTH**3
    # P L² / (E I) = 1 deflects by 0.30172 L (elastica: Bisshopp & Drucker 1945).
    forces = np.array(
        [[1e-4 * LENGTH * stiffness], [-1e-4 * LENGTH * stiffness], [stiffness / 3 * LENGTH]]
    )
    run = run_static_cases(modes, forces, tmp_path / "jobs", names=("up", "down", "large"))
    assert run.status == ("converged",) * 3
    deflection = np.asarray(run.cases.modal_displacement)[:, 0]
    np.testing.assert_allclose(deflection[:2], [1e-4 * LENGTH, -1e-4 * LENGTH], rtol=2e-3)
    np.testing.assert_allclose(deflection[2], 0.30172 * LENGTH, rtol=2e-3)
    linear = 0.5 * forces[:2, 0] * deflection[:2]
    np.testing.assert_allclose(np.asarray(run.cases.energy)[:2], linear, rtol=1e-5)
    assert run.cases.names == ("up", "down", "large")
    assert np.all(run.seconds > 0)


@needs_calculix
def test_small_loads_move_one_mode_by_its_stiffness(write, tmp_path):
    deck = read_deck(write(beam_deck(elements=6)))
    modes = modes_of_deck(deck, (1, 6), tmp_path / "jobs")
    squares = np.asarray(modes.basis.frequency) ** 2
    wanted = 1e-3 * THICKNESS / np.abs(np.asarray(modes.basis.shapes)).max(axis=0)
    run = run_static_cases(modes, np.diag(squares * wanted), tmp_path / "jobs")
    # q = f/ω² of each mode and nothing of the other, to what the printed digits resolve; the local
    # compliance under nodal loads, 7e-4 of the sixth mode, is subtracted, also from the energy.
    np.testing.assert_allclose(run.cases.modal_displacement / wanted, np.eye(2), atol=5e-5)
    np.testing.assert_allclose(run.cases.energy, 0.5 * squares * wanted**2, rtol=1e-5)


@needs_calculix
def test_a_load_beyond_the_structure_diverges_and_the_others_stay(write, tmp_path):
    deck = read_deck(write(beam_deck(elements=2)))
    modes = modes_of_deck(deck, (1,), tmp_path / "jobs")
    force = np.array([[1e-2], [1e12]])
    run = run_static_cases(modes, force, tmp_path / "jobs")
    assert run.status == ("converged", "diverged")
    assert run.errors[0] == ""
    assert run.errors[1]
    assert run.cases.usable.tolist() == [True, False]
    assert np.all(np.isnan(np.asarray(run.cases.displacement)[1]))
    assert run_static_cases(modes, force[1:], tmp_path / "jobs").status == ("diverged",)


# The results of a job as CalculiX prints them, for a deck of five nodes in a row.
def printed(time, deflection):
    rows = "".join(f"{n:10d}  0.000000E+00  0.000000E+00{deflection:14.6E}\n" for n in range(1, 6))
    return (
        f"\n displacements (vx,vy,vz) for set SNRMJAX_NODES and time {time:14.7E}\n\n{rows}\n"
        f" total internal energy for set SNRMJAX_ELEMENTS and time {time:14.7E}\n\n"
        f"      {deflection**2:14.6E}\n"
    )


@pytest.fixture
def small(write):
    """A deck of five nodes with a basis of one shape."""
    deck = read_deck(write(beam_deck(elements=2)))
    shape = np.tile([0.0, 0.0, 1.0], 5)[:, None]
    return DeckModes(
        ReductionBasis(jnp.ones(1), jnp.asarray(shape), jnp.asarray(shape.T / 5), (1,)),
        deck,
        np.ones(1),
        np.zeros((1, 1)),
    )


def test_results_of_an_earlier_run_are_reused(small, tmp_path, program):
    (tmp_path / "printed.dat").write_text(printed(0.5, 1.0) + printed(1.0, 3.0))
    calls = tmp_path / "calls"
    stand_in = program(f"echo x >> {calls}; cp {tmp_path}/printed.dat job.dat")
    done = []

    def run(forces):
        return run_static_cases(
            small,
            forces,
            tmp_path / "jobs",
            program=stand_in,
            progress=lambda *count: done.append(count),
        )

    first = run([[1.0], [2.0]])
    assert first.status == ("converged",) * 2
    assert first.found == 0
    np.testing.assert_allclose(first.cases.modal_displacement, [[3.0], [3.0]])
    np.testing.assert_allclose(first.cases.energy, [9.0, 9.0])
    assert done == [(1, 2), (2, 2)]
    # One case more: only that one is run. The order of cases is the user's.
    second = run([[2.0], [5.0], [1.0]])
    assert (second.found, len(calls.read_text().split())) == (2, 3)
    # A damaged result is run again, the others are not.
    victim = sorted((tmp_path / "jobs").glob("case-*.npz"))[0]
    content = bytearray(victim.read_bytes())
    content[len(content) // 2] ^= 0xFF
    victim.write_bytes(content)
    assert run([[1.0], [2.0], [5.0]]).found == 2
    assert run([[1.0], [2.0], [5.0]]).found == 3
    # Another model in the same folder shares nothing with this one.
    other = DeckModes(small.basis, read_deck(_thicker(tmp_path)), small.carried, np.zeros((1, 1)))
    assert run_static_cases(other, [[1.0]], tmp_path / "jobs", program=stand_in).found == 0
    assert not list((tmp_path / "jobs").glob("job-*"))


def _thicker(folder):
    path = folder / "thicker.inp"
    path.write_text(beam_deck(elements=2).replace("0.002, 0.01", "0.003, 0.01"))
    return path


def test_killed_and_unfinished_cases(small, tmp_path, program):
    whole, half = tmp_path / "whole.dat", tmp_path / "half.dat"
    whole.write_text(printed(1.0, 3.0))
    half.write_text(printed(0.5, 1.0))
    # The load at the second node distinguishes the cases.
    stand_in = program(
        f"""load=$(grep -m1 '^2, 3,' job.inp)
case "$load" in
  *2.0*e-01) kill -9 $$ ;;
  *4.0*e-01) cp {half} job.dat; echo ' *ERROR: too many cutbacks'; exit 201 ;;
  *6.0*e-01) cp {half} job.dat ;;
  *8.0*e-01) head -c 150 {whole} > job.dat ;;
  *) cp {whole} job.dat ;;
esac"""
    )
    forces = np.array([[1.0], [2.0], [3.0], [4.0], [5.0]])
    for _ in range(2):
        run = run_static_cases(small, forces, tmp_path / "jobs", program=stand_in)
        assert run.status == ("killed", "diverged", "diverged", "diverged", "converged")
        assert run.errors[0] == "killed by SIGKILL"
        assert run.errors[1] == "*ERROR: too many cutbacks"
        assert run.errors[2] == "the full load was not reached"
        assert "it is incomplete" in run.errors[3]
        assert run.cases.usable.tolist() == [False] * 4 + [True]
    assert run.found == 4  # all but the killed one, which was tried again


@pytest.mark.parametrize(
    ("script", "message"),
    [("kill -9 $$", "killed by SIGKILL"), ("echo ' *ERROR: no such set'", r"\*ERROR: no such set")],
    ids=["killed", "refused"],
)
def test_not_one_case_could_be_run(small, tmp_path, program, script, message):
    with pytest.raises(ValueError, match=f"CalculiX ran no load case of deck.inp: {message}"):
        run_static_cases(small, [[1.0], [2.0]], tmp_path / "jobs", program=program(script))
    assert not list((tmp_path / "jobs").glob("case-*"))


def test_forces_of_other_modes_and_no_program(small, tmp_path):
    with pytest.raises(ValueError, match=r"`forces` must be finite with 1 columns.*\(1, 2\)"):
        run_static_cases(small, [[1.0, 2.0]], tmp_path / "jobs", program="sh")
    with pytest.raises(ValueError, match="`forces` must be finite"):
        run_static_cases(small, [[np.nan]], tmp_path / "jobs", program="sh")
    with pytest.raises(ValueError, match="no-ccx is not on the search path"):
        run_static_cases(small, [[1.0]], tmp_path / "jobs", program="no-ccx")
    assert not (tmp_path / "jobs").exists()
