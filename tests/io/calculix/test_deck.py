"""Decks are read with their included files and parts, and refused by file and line."""

import numpy as np
import pytest

from snrmjax.io.calculix.deck import read_deck

from .conftest import LENGTH, beam_deck


def test_the_mesh_of_a_deck(write):
    deck = read_deck(write(beam_deck(elements=4)))
    assert deck.nodes.tolist() == list(range(1, 10))
    assert deck.elements.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(deck.coordinates[:, 0], np.linspace(0, LENGTH, 9), rtol=1e-11)
    assert deck.element_types == ("B32R",)
    assert deck.nearest_node((LENGTH / 2, 0.0, 0.0)) == 5
    assert deck.node_index(5) == 4
    assert deck.thickness == 0.002
    with pytest.raises(ValueError, match="no element with node 12"):
        deck.node_index(12)


def test_included_files_are_inserted(write):
    nodes, rest = beam_deck().split("*ELEMENT", 1)
    write(nodes, "mesh.inp")
    deck = read_deck(write("*Include, Input=mesh.inp\n*ELEMENT" + rest))
    assert deck.text == read_deck(write(beam_deck(), "whole.inp")).text
    assert "INCLUDE" not in deck.text.upper()


def test_supports_of_the_first_step_stay_and_its_loads_go(write):
    steps = (
        "*STEP, NLGEOM\n*STATIC\n1., 1.\n*BOUNDARY, OP=MOD\n13, 3, 3\n*CLOAD\n7, 3, 1.\n"
        "*NODE FILE\nU\n*END STEP\n*STEP\n*FREQUENCY\n3\n*BOUNDARY\n5, 3, 3\n*END STEP"
    )
    deck = read_deck(write(beam_deck(steps=steps)))
    assert deck.left_out == ("CLOAD",)
    assert deck.text.endswith("*BOUNDARY\n1, 1, 6\n*BOUNDARY\n13, 3, 3\n")


@pytest.mark.parametrize(
    ("steps", "small"),
    [
        ("", False),  # nothing is stated that could be replaced
        ("*STEP\n*STATIC\n*END STEP", True),
        ("*STEP, NLGEOM=NO\n*STATIC\n*END STEP", True),
        ("*STEP\n*FREQUENCY\n3\n*END STEP\n*Step, Inc=9, nlgeom\n*STATIC\n*END STEP", False),
        ("*STEP, NLGEOM=YES\n*STATIC\n*END STEP", False),
    ],
)
def test_steps_without_large_displacements_are_known(write, steps, small):
    assert read_deck(write(beam_deck(steps=steps))).small_displacements is small


def test_unknown_keywords_are_kept_unchanged(write):
    deck = read_deck(
        write(beam_deck() + "*EQUATION\n2\n13, 3, 1., 11, 3, -1.\n*ORIENTATION, NAME=O\n")
    )
    assert deck.text.endswith("*EQUATION\n2\n13, 3, 1., 11, 3, -1.\n*ORIENTATION, NAME=O\n")


def test_elements_on_two_lines(write):
    nodes = "".join(f"{i}, {i}., {i % 3}., {i % 2}.\n" for i in range(1, 21))
    numbers = [str(i) for i in range(1, 21)]
    element = "7, " + ", ".join(numbers[:10]) + ",\n" + ", ".join(numbers[10:])
    rest = "*MATERIAL, NAME=M\n*ELASTIC\n1., 0.\n*DENSITY\n1."
    deck = read_deck(write(f"*NODE\n{nodes}*ELEMENT, TYPE=C3D20R\n{element}\n{rest}\n"))
    assert deck.elements.tolist() == [7]
    assert deck.nodes.tolist() == list(range(1, 21))


GOOD = beam_deck()
BAD = {
    "no nodes": (GOOD.replace("*NODE, NSET=ALL", "*COMMENT"), r"no \*NODE block"),
    "no elements": (GOOD.replace("*ELEMENT, TYPE=B32R", "*COMMENT"), r"no \*ELEMENT block"),
    "word for a coordinate": (
        GOOD.replace("1, 0, 0., 0.", "1, zero, 0., 0."),
        "deck.inp, line 3: 'zero' where a coordinate is expected",
    ),
    "coordinate too long": (
        GOOD.replace("1, 0, 0., 0.", "1, 0.123456789012345678e-3, 0., 0."),
        "line 3: the coordinate 0.123456789012345678e-3 has 23 characters",
    ),
    "element's node missing": (
        GOOD.replace("6, 11, 12, 13", "6, 11, 12, 99"),
        "line 22: the element has node 99, which no",
    ),
    "element number broken": (GOOD.replace("\n6, 11,", "\n6.5, 11,"), "line 22: '6.5' where"),
    "support's node missing": (beam_deck(supports=("99, 1, 6",)), "support is at node 99"),
    "support's set missing": (beam_deck(supports=("END, 1, 6",)), "no node set is called 'END'"),
    "support moves": (beam_deck(supports=("1, 3, 3, 0.01",)), "displacement 0.01 is prescribed"),
    "no density": (beam_deck(material="*ELASTIC\n2e11, 0.3"), r"no \*DENSITY: modes need a mass"),
    "negative density": (
        beam_deck(material="*ELASTIC\n2e11, 0.3\n*DENSITY\n-7800."),
        r"\*DENSITY must be positive, but is -7800",
    ),
    "no elastic law": (beam_deck(material="*DENSITY\n7800."), r"no \*ELASTIC or \*HYPERELASTIC"),
    "modulus zero": (
        beam_deck(material="*ELASTIC\n0., 0.3\n*DENSITY\n7800."),
        r"\*ELASTIC must be positive, but is 0",
    ),
    "plastic": (
        beam_deck(material="*ELASTIC\n2e11, 0.3\n*PLASTIC\n1e8, 0.\n*DENSITY\n7800."),
        r"\*PLASTIC: a reduced stiffness has a potential",
    ),
    "contact": (GOOD + "*CONTACT PAIR, INTERACTION=I\nA, B\n", r"\*CONTACT PAIR: contact has no"),
    "local system": (GOOD + "*TRANSFORM, NSET=ALL\n1., 0., 0., 0., 1., 0.\n", r"\*TRANSFORM: disp"),
    "parts": ("*Part, name=A\n" + GOOD, r"\*PART: CalculiX reads no parts and assemblies"),
    "user element": (GOOD.replace("TYPE=B32R", "TYPE=U1"), "user elements are linear"),
    "thickness zero": (GOOD.replace("0.002, 0.01", "0., 0.01"), "must be positive, but one is 0"),
    "include missing": ("*INCLUDE, INPUT=mesh.inp\n" + GOOD, "included file mesh.inp does not"),
    "includes itself": ("*INCLUDE, INPUT=deck.inp\n" + GOOD, "deck.inp includes itself"),
    "include of nothing": ("*INCLUDE\n" + GOOD, r"\*INCLUDE needs INPUT=file"),
    "data first": ("1, 2, 3\n" + GOOD, "'1, 2, 3' comes before the first keyword"),
    "empty": ("", r"no \*NODE block"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=list(BAD))
def test_a_deck_that_cannot_be_used_is_refused_by_line(write, text, message):
    with pytest.raises(ValueError, match=message) as raised:
        read_deck(write(text))
    assert "\n" not in str(raised.value)


def test_a_missing_deck(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        read_deck(tmp_path / "deck.inp")
