"""Linear modes of a CalculiX deck, with their nodal forces and modal filter."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.condense.load_cases import ReductionBasis
from snrmjax.io.calculix.deck import Deck
from snrmjax.io.calculix.jobs import (
    Calculix,
    eigenvalues,
    find_calculix,
    model_file,
    printed_tables,
    run_job,
)
from snrmjax.io.files import FilePath
from snrmjax.numerics.rules import InputError

ALL_NODES = "SNRMJAX_NODES"
# Extra modes: a free structure has six rigid-body modes before the first elastic one.
_MORE_MODES = 6
# Rigid-body eigenvalues are round-off of the stiffness: relative to the largest one computed.
_RIGID_RATIO = 1e-7
# Fixed nodes of beams and shells move by the round-off of their constraints: relative amplitude.
_FIXED = 1e-10
# Fraction of a mode's inertia that nodal translations must carry.
_LEAST_CARRIED = 0.9


class DeckModes(eqx.Module):
    """Modes of a deck: the basis of a reduced model, in degrees of freedom x, y, z of each node.

    Degree of freedom 3 i + d is the translation in direction d of `deck.nodes[i]`. `carried` is
    the fraction of each mode's inertia that nodal translations carry: one except for rotary inertia
    and the distortion of a section.
    """

    basis: ReductionBasis
    deck: Deck
    carried: Float[np.ndarray, " mode"] = eqx.field(converter=np.asarray)
    residual_flexibility: Float[np.ndarray, "mode mode"] = eqx.field(converter=np.asarray)  # s²
    seconds: float = 0.0  # run time of CalculiX

    def modal_displacement(
        self,
        displacement: Float[np.ndarray, "case dof"],
        force: Float[np.ndarray, "case mode"],
    ) -> Float[np.ndarray, "case mode"]:
        """Modal coordinates q of static displacements (m) under modal forces f.

        q = G ᵀu − (GᵀK⁻¹G − ω⁻²) f: the local compliance under nodal
        loads (on a beam they act at the centre of its section) is no motion of the mode.
        """
        projected: Float[np.ndarray, "case mode"] = displacement @ np.asarray(self.basis.filter).T
        return projected - force @ self.residual_flexibility

    def shape_at(self, node: int, direction: int | str) -> Float[np.ndarray, " mode"]:
        """Mass-normalised shapes (kg^-1/2) at a node in direction 0, 1, 2 or "x", "y", "z"."""
        axis = "xyz".index(direction) if isinstance(direction, str) else direction
        return np.asarray(self.basis.shapes)[3 * self.deck.node_index(node) + axis]

    def participation(self, direction: int | str) -> Float[np.ndarray, " mode"]:
        """ΦᵀF (kg^-1/2) of a unit force on every node in one direction."""
        axis = "xyz".index(direction) if isinstance(direction, str) else direction
        return np.asarray(self.basis.shapes)[axis::3].sum(axis=0)


class ModeSurvey(eqx.Module):
    """The first modes of a deck, to choose from: those that can be kept and those that cannot."""

    frequency: Float[np.ndarray, " mode"] = eqx.field(converter=np.asarray)  # rad/s
    shapes: Float[np.ndarray, "dof mode"] = eqx.field(converter=np.asarray)  # kg^-1/2
    momenta: Float[np.ndarray, "dof mode"] = eqx.field(converter=np.asarray)  # M Φ, kg^1/2
    seconds: float  # run time of CalculiX

    @property
    def carried(self) -> Float[np.ndarray, " mode"]:
        """Fraction of each mode's inertia that nodal translations carry."""
        return np.sum(self.shapes * self.momenta, axis=0)

    @property
    def effective_mass(self) -> Float[np.ndarray, "mode 3"]:
        """Effective mass (kg) in x, y and z, which shows a mode's direction of motion."""
        return self.momenta.reshape(-1, 3, len(self.frequency)).sum(axis=0).T ** 2

    def only(self, kept: Sequence[int]) -> "ModeSurvey":
        """Some of the modes, by index from zero."""
        rows = list(kept)
        return ModeSurvey(
            self.frequency[rows], self.shapes[:, rows], self.momenta[:, rows], self.seconds
        )


def survey_modes(
    deck: Deck,
    count: int,
    folder: FilePath,
    *,
    program: str = "ccx",
    time_limit: float = 3600.0,
) -> ModeSurvey:
    """The first modes of a deck by CalculiX, to choose from.

    Arguments and errors as `modes_of_deck`; modes that nodal translations do not carry are kept.
    Returns a `ModeSurvey` of `count` modes.
    """
    (count,) = _checked([count])
    return _survey(deck, count, folder, find_calculix(program, time_limit))


def modes_of_deck(
    deck: Deck,
    numbers: Sequence[int],
    folder: FilePath,
    *,
    program: str = "ccx",
    time_limit: float = 3600.0,
) -> DeckModes:
    """Modes of a deck by CalculiX, with M Φ from its nodal forces.

    CalculiX prints the internal forces of a mode, KΦ = ω²MΦ, at the nodes of the deck, for beams
    and shells as resultants over their expanded solids. R = KΦ/ω² is M Φ without a mass
    matrix, for any element, point masses and consistent masses included. Load cases and filter
    both use G = R (ΦᵀR)⁻¹: ΦᵀG = I holds to round-off, so that loads and modal coordinates stay
    conjugate. For solids ΦᵀR = I already; for beams and shells it lacks the rotary inertia of the
    section, some 1e-5 to 1e-2 (`carried`).

    Arguments: `deck`; `numbers` of the modes to keep, from one; `folder` for its files; `program`
    and its `time_limit` (s). Returns `DeckModes`, largest translation of each mode positive.
    Raises `ValueError` where CalculiX is missing, killed or refuses the deck, where a mode is rigid
    (a mechanism) or does not exist, and for a mode that nodal translations do not carry, such as
    torsion of a beam.
    """
    wanted = _checked(numbers)
    calculix = find_calculix(program, time_limit)
    survey = _survey(deck, max(wanted), folder, calculix)
    kept = [number - 1 for number in wanted]
    survey = survey.only(kept)
    _check_carried(deck, wanted, survey.carried)
    conjugate = np.linalg.solve(survey.momenta.T @ survey.shapes, survey.momenta.T)
    model = model_file(deck.text + all_nodes(deck), folder)
    outcome = run_job(calculix, model, _linear_steps(deck, conjugate))
    tables = list(printed_tables(outcome.dat, deck.nodes)) if outcome.finished else []
    if outcome.error or len(tables) != len(kept):
        reason = outcome.error or "a load case is missing"
        raise InputError(f"CalculiX gave no linear static load cases of {deck.name}: {reason}.")
    flexibility = conjugate @ np.array([table.values.ravel() for table in tables]).T
    return DeckModes(
        ReductionBasis(
            jnp.asarray(survey.frequency),
            jnp.asarray(survey.shapes),
            jnp.asarray(conjugate),
            wanted,
        ),
        deck,
        survey.carried,
        (flexibility + flexibility.T) / 2 - np.diag(survey.frequency**-2.0),
        survey.seconds + outcome.seconds,
    )


def _survey(deck: Deck, count: int, folder: FilePath, calculix: Calculix) -> ModeSurvey:
    model = model_file(deck.text + all_nodes(deck), folder)
    outcome = run_job(calculix, model, _step(count + _MORE_MODES))
    squares = eigenvalues(outcome.dat)
    tables = list(printed_tables(outcome.dat, deck.nodes)) if outcome.finished else []
    shapes = [t.values.ravel() for t in tables if t.quantity == "displacements"]
    forces = [t.values.ravel() for t in tables if t.quantity == "forces"]
    if outcome.error or not shapes or len(shapes) != len(forces):
        reason = outcome.error or "it printed no modes"
        raise InputError(f"CalculiX gave no modes of {deck.name}: {reason}.")
    if len(shapes) < count:
        raise InputError(
            f"mode {count} of {deck.name} was asked for, but CalculiX found {len(shapes)}."
        )
    _check_rigid(deck, squares)
    return _signed(
        np.sqrt(squares[:count]),
        np.array(shapes[:count]).T,
        np.array(forces[:count]).T / squares[:count],
        outcome.seconds,
    )


def all_nodes(deck: Deck) -> str:
    """A set of all nodes of elements, for the printed output."""
    rows = [deck.nodes[i : i + 8] for i in range(0, len(deck.nodes), 8)]
    return "\n".join(
        [f"*NSET, NSET={ALL_NODES}", *(", ".join(map(str, row)) + "," for row in rows), ""]
    )


def load_rows(deck: Deck, loads: Float[np.ndarray, " dof"]) -> list[str]:
    """Nodal forces (N) as lines of a deck."""
    table = loads.reshape(-1, 3)
    rows = [
        f"{label}, {direction + 1}, {table[node, direction]:.12e}"
        for node, label in enumerate(deck.nodes)
        for direction in range(3)
        if table[node, direction]
    ]
    return ["*CLOAD, OP=NEW", *rows] if rows else []


def _linear_steps(deck: Deck, conjugate: Float[np.ndarray, "mode dof"]) -> str:
    """A linear static step for the unit force of each mode."""
    printed = [f"*NODE PRINT, NSET={ALL_NODES}", "U", "*END STEP"]
    steps = [["*STEP", "*STATIC", *load_rows(deck, row), *printed] for row in conjugate]
    return "\n".join([*(line for step in steps for line in step), ""])


def _step(count: int) -> str:
    return "\n".join(
        ["*STEP", "*FREQUENCY", str(count), f"*NODE PRINT, NSET={ALL_NODES}", "U, RF", "*END STEP"]
    )


def _checked(numbers: Sequence[int]) -> tuple[int, ...]:
    wanted = tuple(int(number) for number in numbers)
    if not wanted or min(wanted) < 1 or len(set(wanted)) != len(wanted):
        raise InputError(
            f"modes are different numbers from one, as 1, 3, 5, but {list(numbers)} are asked for."
        )
    return wanted


def _signed(
    frequency: Float[np.ndarray, " mode"],
    shapes: Float[np.ndarray, "dof mode"],
    momenta: Float[np.ndarray, "dof mode"],
    seconds: float,
) -> ModeSurvey:
    """Modes with their largest translation positive, without the reactions of fixed nodes."""
    heights = np.abs(shapes).max(axis=0)
    fixed = np.all(np.abs(shapes) <= _FIXED * heights, axis=1, keepdims=True)
    momenta = np.where(fixed, 0.0, momenta)
    # Where two peaks are equal to round-off, the first sets the sign.
    peaks = np.argmax(np.abs(shapes) > 0.999 * heights, axis=0)
    signs = np.sign(shapes[peaks, np.arange(shapes.shape[1])])
    return ModeSurvey(frequency, shapes * signs, momenta * signs, seconds)


def _check_rigid(deck: Deck, squares: Float[np.ndarray, " mode"]) -> None:
    rigid = int(np.sum(squares <= _RIGID_RATIO * np.max(np.abs(squares))))
    if rigid:
        raise InputError(
            f"{deck.name} has {rigid} mode{'s' if rigid > 1 else ''} without stiffness among its "
            f"first {len(squares)}: the structure is a mechanism or not supported; add "
            "supports (*BOUNDARY)."
        )


def _check_carried(deck: Deck, wanted: tuple[int, ...], carried: np.ndarray) -> None:
    for number, fraction in zip(wanted, carried, strict=True):
        if not fraction >= _LEAST_CARRIED:
            raise InputError(
                f"mode {number} of {deck.name} moves its nodes too little: their translations "
                f"carry {100 * fraction:.0f} % of its inertia (torsion of a beam?); leave it out "
                "or model it with shells or solids."
            )
