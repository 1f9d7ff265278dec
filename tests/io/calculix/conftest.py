"""Small decks, and substitute programs for failures of CalculiX."""

import shutil

import pytest

# A steel cantilever; the width is its thickness in the other direction.
LENGTH, WIDTH, THICKNESS = 0.2, 0.01, 0.002
YOUNG, POISSON, DENSITY = 200e9, 0.0, 7800.0  # a section without Poisson effect: beam theory

needs_calculix = pytest.mark.skipif(
    shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed"
)


def beam_deck(elements=6, kind="B32R", supports=("1, 1, 6",), material="", steps=""):
    """A beam along x, thin in z, of three-node elements."""
    last = 2 * elements
    nodes = [f"{i + 1}, {LENGTH * i / last:.12g}, 0., 0." for i in range(last + 1)]
    rows = [f"{e + 1}, {2 * e + 1}, {2 * e + 2}, {2 * e + 3}" for e in range(elements)]
    material = material or f"*ELASTIC\n{YOUNG}, {POISSON}\n*DENSITY\n{DENSITY}"
    return "\n".join(
        [
            *("** a cantilever", "*NODE, NSET=ALL", *nodes),
            *(f"*ELEMENT, TYPE={kind}, ELSET=BEAM", *rows),
            *("*MATERIAL, NAME=STEEL", material),
            "*BEAM SECTION, ELSET=BEAM, MATERIAL=STEEL, SECTION=RECT",
            *(f"{THICKNESS}, {WIDTH}", "0., 0., 1."),
            *(["*BOUNDARY", *supports] if supports else []),
            *([steps] if steps else []),
            "",
        ]
    )


@pytest.fixture
def write(tmp_path):
    """Writes a deck into a folder of the test."""

    def deck(text, name="deck.inp"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return deck


@pytest.fixture
def program(tmp_path):
    """Create a shell script that is called instead of CalculiX."""

    def made(script):
        path = tmp_path / "ccx-stand-in"
        path.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        path.chmod(0o755)
        return str(path)

    return made
