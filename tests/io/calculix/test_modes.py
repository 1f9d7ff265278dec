"""Modes by CalculiX against beam theory, and all failures."""

import numpy as np
import pytest

from snrmjax.io.calculix.deck import read_deck
from snrmjax.io.calculix.modes import modes_of_deck, survey_modes

from .conftest import DENSITY, LENGTH, POISSON, THICKNESS, WIDTH, YOUNG, beam_deck, needs_calculix

# (βL) of a cantilever: roots of cos x cosh x = -1.
ROOTS = np.array([1.8751040687, 4.6940911330])


def bending_frequency(root, thickness):
    """Natural frequency (rad/s) of an Euler-Bernoulli beam."""
    return (root / LENGTH) ** 2 * thickness * np.sqrt(YOUNG / (12 * DENSITY))


@needs_calculix
def test_a_cantilever_of_beams_has_its_frequencies_and_shapes(write, tmp_path):
    modes = modes_of_deck(read_deck(write(beam_deck(elements=12))), (1, 3), tmp_path / "jobs")
    # Without Poisson's effect only the mesh of 12 elements and shear are left: below 0.3 %.
    frequency = np.asarray(modes.basis.frequency)
    np.testing.assert_allclose(frequency, bending_frequency(ROOTS, THICKNESS), rtol=3e-3)
    # A cantilever's mass-normalised tip is 2 / sqrt(its mass) in every bending mode.
    mass = DENSITY * LENGTH * WIDTH * THICKNESS
    tip = modes.deck.nearest_node((LENGTH, 0.0, 0.0))
    np.testing.assert_allclose(np.abs(modes.shape_at(tip, "z")), 2 / np.sqrt(mass), rtol=3e-3)
    np.testing.assert_allclose(modes.shape_at(tip, 1), 0.0, atol=1e-6)
    # Nodal translations carry all inertia except the section's rotary inertia.
    np.testing.assert_allclose(modes.carried, 1.0, atol=5e-3)
    basis = modes.basis
    np.testing.assert_allclose(basis.filter @ basis.shapes, np.eye(2), atol=1e-12)
    assert basis.numbers == (1, 3)  # mode 2 bends the other way


@needs_calculix
def test_reactions_of_supports_are_no_inertia(write, tmp_path):
    # At both clamps beams have reactions, whose sum is minus the total inertia.
    deck = read_deck(write(beam_deck(elements=8, supports=("1, 1, 6", "17, 1, 6"))))
    masses = survey_modes(deck, 2, tmp_path / "jobs").effective_mass
    # A clamped beam's first mode has 69.0 % of the mass, its second, antisymmetric none; rows of
    # fixed nodes are left out, some 0.4 % with 8 elements.
    mass = DENSITY * LENGTH * WIDTH * THICKNESS
    wanted = [[0.0, 0.0, 0.690], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(masses[:2] / mass, wanted, atol=5e-3)


def shell_deck(elements=8):
    """The cantilever of quadratic shells, one across the width."""
    number = {}
    for i in range(2 * elements + 1):
        for j in range(3):
            if i % 2 == 0 or j % 2 == 0:
                number[i, j] = len(number) + 1
    nodes = [
        f"{n}, {LENGTH * i / (2 * elements):.10g}, {WIDTH * j / 2:.10g}, 0."
        for (i, j), n in number.items()
    ]
    around = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    rows = [
        ", ".join([str(e + 1), *(str(number[2 * e + i, j]) for i, j in around)])
        for e in range(elements)
    ]
    return "\n".join(
        [
            *("*NODE", *nodes, "*ELEMENT, TYPE=S8R, ELSET=E", *rows),
            f"*MATERIAL, NAME=M\n*ELASTIC\n{YOUNG}, {POISSON}\n*DENSITY\n{DENSITY}",
            f"*SHELL SECTION, ELSET=E, MATERIAL=M\n{THICKNESS}\n*BOUNDARY",
            *(f"{number[0, j]}, 1, 6" for j in range(3)),
            "",
        ]
    )


@needs_calculix
def test_a_cantilever_of_shells_has_its_frequency(write, tmp_path):
    modes = modes_of_deck(read_deck(write(shell_deck())), (1,), tmp_path / "jobs")
    frequency = float(modes.basis.frequency[0])
    assert abs(frequency / bending_frequency(ROOTS[0], THICKNESS) - 1) < 3e-3  # as for beams
    assert abs(modes.carried[0] - 1) < 1e-3
    # The local compliance under nodal loads is negligible for shells.
    assert abs(modes.residual_flexibility[0, 0]) * frequency**2 < 1e-5


def solid_deck():
    """A clamped block of two quadratic bricks along x."""
    numbering = {}
    for i in range(5):
        for j in range(3):
            for k in range(3):
                if (i % 2) + (j % 2) + (k % 2) <= 1:
                    numbering[i, j, k] = len(numbering) + 1
    nodes = [
        f"{n}, {0.01 * i:g}, {0.005 * j:g}, {0.005 * k:g}" for (i, j, k), n in numbering.items()
    ]
    corners = [
        (0, 0, 0),
        (2, 0, 0),
        (2, 2, 0),
        (0, 2, 0),
        (0, 0, 2),
        (2, 0, 2),
        (2, 2, 2),
        (0, 2, 2),
    ]
    middles = [*((0, 1), (1, 2), (2, 3), (3, 0)), *((4, 5), (5, 6), (6, 7), (7, 4))]
    middles += [(0, 4), (1, 5), (2, 6), (3, 7)]
    local = corners + [
        tuple((a + b) // 2 for a, b in zip(corners[p], corners[q], strict=True)) for p, q in middles
    ]
    rows = [
        f"{e + 1}, " + ", ".join(str(numbering[i + 2 * e, j, k]) for i, j, k in local)
        for e in range(2)
    ]
    # CalculiX takes at most 16 numbers a line.
    rows = [
        ", ".join(row.split(", ")[:11]) + ",\n" + ", ".join(row.split(", ")[11:]) for row in rows
    ]
    fixed = [f"{n}, 1, 3" for (i, _, _), n in numbering.items() if i == 0]
    return "\n".join(
        [
            *("*NODE, NSET=ALL", *nodes, "*ELEMENT, TYPE=C3D20, ELSET=E", *rows),
            f"*MATERIAL, NAME=M\n*ELASTIC\n{YOUNG}, {POISSON}\n*DENSITY\n{DENSITY}",
            *("*SOLID SECTION, ELSET=E, MATERIAL=M\n*BOUNDARY", *fixed, ""),
        ]
    )


@needs_calculix
def test_nodal_forces_of_solids_are_mass_times_shape(write, tmp_path):
    modes = modes_of_deck(read_deck(write(solid_deck())), (1, 2, 3), tmp_path / "jobs")
    # ΦᵀMΦ = 1 to the seven digits that CalculiX prints.
    np.testing.assert_allclose(modes.carried, 1.0, atol=1e-5)
    # M times a unit translation, summed over the modes, misses what the clamped nodes carry only:
    # the participation of unit acceleration stays below the block's mass.
    sum_of_masses = np.sum(np.asarray(modes.basis.filter)[:, 1::3], axis=1)
    assert 0.5 < np.sum(sum_of_masses**2) / (DENSITY * 0.04 * 0.01 * 0.01) < 1.0


@needs_calculix
@pytest.mark.parametrize(
    ("text", "numbers", "message"),
    [
        (beam_deck(supports=()), (1,), "deck.inp has 6 modes without stiffness"),
        (beam_deck(supports=("1, 1, 3",)), (1,), "mechanism or not supported"),
        (beam_deck(elements=2).replace("MATERIAL=STEEL,", "MATERIAL=WOOD,"), (1,), r"\*ERROR"),
    ],
    ids=["free", "hinged", "material missing"],
)
def test_decks_without_modes(write, tmp_path, text, numbers, message):
    with pytest.raises(ValueError, match=message) as raised:
        modes_of_deck(read_deck(write(text)), numbers, tmp_path / "jobs")
    assert "\n" not in str(raised.value)


@needs_calculix
def test_torsion_of_a_beam_is_refused(write, tmp_path):
    square = beam_deck().replace(f"{THICKNESS}, {WIDTH}", "0.02, 0.02")
    deck = read_deck(write(square))
    survey = survey_modes(deck, 5, tmp_path / "jobs")
    assert (survey.carried > 0.9).tolist() == [True] * 4 + [False]
    # Bending of a square section comes in pairs; in all, both ways are alike.
    masses = survey.effective_mass[:4]
    np.testing.assert_allclose(masses[:2].sum(axis=0)[1:], masses[:2].sum() / 2, rtol=1e-3)
    # A cantilever's first bending mode has 61.3 % of the mass.
    np.testing.assert_allclose(
        masses[:2].sum() / 2 / (DENSITY * LENGTH * 0.02**2), 0.613, atol=0.006
    )
    with pytest.raises(ValueError, match=r"mode 5 .* translations carry 0 % of its inertia"):
        modes_of_deck(deck, (5,), tmp_path / "jobs")


@pytest.mark.parametrize("numbers", [(), (0,), (1, 1)])
def test_numbers_that_name_no_modes(write, tmp_path, numbers):
    with pytest.raises(ValueError, match="modes are different numbers from one"):
        modes_of_deck(read_deck(write(beam_deck())), numbers, tmp_path)


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("kill -9 $$", "CalculiX gave no modes of deck.inp: killed by SIGKILL"),
        ("sleep 60", "stopped after the time limit of 0.2 s"),
        ("exit 3", "it ended with code 3"),
        ("echo ' *ERROR reading *STEP: no memory'; exit 201", r"\*ERROR reading \*STEP: no memory"),
        ("exit 0", "it printed no modes"),
    ],
    ids=["killed", "time limit", "code", "error", "silent"],
)
def test_a_program_that_fails(write, tmp_path, program, script, message):
    with pytest.raises(ValueError, match=message):
        modes_of_deck(
            read_deck(write(beam_deck())),
            (1,),
            tmp_path / "jobs",
            program=program(f"{'exec ' if 'sleep' in script else ''}{script}"),
            time_limit=0.2 if "sleep" in script else 60.0,
        )
    assert [path.name[:6] for path in (tmp_path / "jobs").iterdir()] == ["model-"]


def test_without_calculix(write, tmp_path):
    deck = read_deck(write(beam_deck()))
    with pytest.raises(ValueError, match=r"no-ccx is not on the search path: install it .*apt"):
        modes_of_deck(deck, (1,), tmp_path / "jobs", program="no-ccx")
    assert not (tmp_path / "jobs").exists()
    with pytest.raises(ValueError, match="`time_limit` must be positive"):
        modes_of_deck(deck, (1,), tmp_path / "jobs", program="sh", time_limit=0.0)
