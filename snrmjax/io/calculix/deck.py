"""A user's CalculiX deck: its mesh, its checks, and the model text of the jobs."""

import re

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from snrmjax.io.calculix.blocks import Block, Line, read_blocks
from snrmjax.io.files import FilePath, file_name, shown
from snrmjax.numerics.rules import InputError

# CalculiX reads a coordinate from this many characters and silently drops the rest.
_COORDINATE_WIDTH = 20
_ELASTIC = ("ELASTIC", "HYPERELASTIC", "HYPERFOAM")
_LOSSY = (
    *("PLASTIC", "CREEP", "CYCLIC HARDENING", "DEFORMATION PLASTICITY", "USER MATERIAL", "VISCO"),
    *("DAMAGE INITIATION", "MOHR COULOMB", "COULOMB PLASTICITY"),
)
_REFUSED = {
    "CONTACT PAIR": "contact has no smooth potential",
    "TIE": "tied surfaces move nodes by constraints that a load case does not see; "
    "join the meshes or use *EQUATION",
    "TRANSFORM": "displacements in local systems cannot be read back; write the supports in "
    "global directions or with *EQUATION",
    "USER ELEMENT": "user elements are linear",
    "PART": "CalculiX reads no parts and assemblies; in Abaqus/CAE choose `Do not use parts and "
    "assemblies in input files`",
}
# Step keywords that do not change the structure: left out without a note.
_QUIET = {
    *("STEP", "END STEP", "BOUNDARY", "STATIC", "FREQUENCY", "BUCKLE", "CONTROLS", "HEADING"),
    *("NODE PRINT", "EL PRINT", "NODE FILE", "EL FILE", "NODE OUTPUT", "ELEMENT OUTPUT", "OUTPUT"),
    *("RESTART", "MONITOR", "PRINT"),
}
_RIGID_ZERO = 1e-9  # prescribed displacements up to this value count as zero


class Deck(eqx.Module):
    """The model part of a CalculiX deck: everything before its first step, as text and mesh.

    Supports of the first step are included; loads and outputs of the steps are left out
    (`left_out` names their keywords). Lengths, moduli and densities are in the deck's units: a
    deck in metres, pascals and kilograms gives a model in SI units.
    """

    name: str = eqx.field(static=True)
    text: str = eqx.field(static=True)
    nodes: Int[np.ndarray, " node"] = eqx.field(converter=np.asarray)  # of elements, ascending
    coordinates: Float[np.ndarray, "node 3"] = eqx.field(converter=np.asarray)  # m
    elements: Int[np.ndarray, " element"] = eqx.field(converter=np.asarray)  # numbers, ascending
    element_types: tuple[str, ...] = eqx.field(static=True)
    thickness: float = eqx.field(static=True)  # m, the smallest of its sections
    left_out: tuple[str, ...] = eqx.field(static=True, default=())
    small_displacements: bool = eqx.field(static=True, default=False)  # no step has NLGEOM

    def node_index(self, number: int) -> int:
        """Index of a node in `nodes`. Raises `ValueError` where no element has it."""
        rows = np.flatnonzero(self.nodes == number)
        if not len(rows):
            raise InputError(
                f"{self.name} has no element with node {number} (nodes {self.nodes[0]} to "
                f"{self.nodes[-1]})."
            )
        return int(rows[0])

    def nearest_node(self, point: tuple[float, float, float]) -> int:
        """The number of the node next to a point (m)."""
        distance = np.linalg.norm(self.coordinates - np.asarray(point), axis=1)
        return int(self.nodes[int(np.argmin(distance))])


def read_deck(path: FilePath) -> Deck:
    """Read a CalculiX input deck (or one of Abaqus without parts) of beams, shells or solids.

    Unknown keywords are kept unchanged, *INCLUDE files are inserted.

    Arguments: `path` of the deck. Returns the `Deck`. Raises `ValueError`, with file and line, for
    anything a condensation cannot use: no mesh, an element or a support with a missing node, a
    prescribed displacement, a material without density or elastic constants, plasticity and other
    dissipative materials, contact, local coordinate systems.
    """
    blocks = read_blocks(path)
    name = file_name(path)
    model, supports, left_out = _split(blocks)
    nodes = _nodes(model, name)
    elements, used, types = _elements(model, nodes, name)
    kept = [*model, *supports]
    _check_supports(kept, set(nodes), _node_sets(model))
    _check_materials(model, name)
    labels = np.array(sorted(used))
    return Deck(
        name=name,
        text="\n".join(block.text for block in kept) + "\n",
        nodes=labels,
        coordinates=np.array([nodes[label] for label in labels]),
        elements=np.array(sorted(elements)),
        element_types=types,
        thickness=_thickness(model, np.array([nodes[label] for label in labels])),
        left_out=left_out,
        small_displacements=_small_displacements(blocks),
    )


def _split(blocks: list[Block]) -> tuple[list[Block], list[Block], tuple[str, ...]]:
    """The model part, the supports of the first step, and the step keywords left out."""
    first = next((i for i, b in enumerate(blocks) if b.keyword == "STEP"), len(blocks))
    supports, left_out, step = [], [], 0
    for block in blocks[first:]:
        step += block.keyword == "STEP"
        if block.keyword == "BOUNDARY" and step == 1:
            supports.append(block.with_parameters(OP=None))
        elif block.keyword not in _QUIET:
            left_out.append(block.keyword)
    unwanted = {"NODE PRINT", "EL PRINT", "NODE FILE", "EL FILE", "NODE OUTPUT", "OUTPUT"}
    model = [block for block in blocks[:first] if block.keyword not in unwanted]
    return model, supports, tuple(dict.fromkeys(left_out))


def _small_displacements(blocks: list[Block]) -> bool:
    """Whether there are steps, and all are geometrically linear."""
    steps = [block for block in blocks if block.keyword == "STEP"]
    large = [s for s in steps if "NLGEOM" in s.parameters and s.named("NLGEOM") != "NO"]
    return bool(steps) and not large


def _thickness(blocks: list[Block], coordinates: Float[np.ndarray, "node 3"]) -> float:
    """The smallest dimension of shell and beam sections, or of the mesh where it has neither."""
    dimensions = []
    for block in blocks:
        beam = block.keyword == "BEAM SECTION"
        if (beam or block.keyword == "SHELL SECTION") and block.data:
            line = block.data[0]
            entries = line.entries[: 2 if beam else 1]
            dimensions += [_number(line, entry, "a dimension") for entry in entries if entry]
            if dimensions[-1:] and not min(dimensions) > 0:
                raise InputError(
                    f"{line.location}: dimensions of a section must be positive, but one is "
                    f"{min(dimensions):g}."
                )
    if dimensions:
        return min(dimensions)
    spans = np.ptp(coordinates, axis=0)
    return float(np.min(spans[spans > 0], initial=np.inf)) if np.any(spans > 0) else 1.0


def _number(line: Line, entry: str, wanted: str) -> float:
    try:
        return float(re.sub("[dD]", "e", entry))
    except ValueError as error:
        raise InputError(f"{line.location}: {shown(entry)} where {wanted} is expected.") from error


def _label(line: Line, entry: str, wanted: str) -> int:
    value = _number(line, entry, wanted)
    if not value.is_integer() or value < 1:
        raise InputError(f"{line.location}: {shown(entry)} where {wanted} is expected.")
    return int(value)


def _nodes(blocks: list[Block], name: str) -> dict[int, tuple[float, ...]]:
    nodes: dict[int, tuple[float, ...]] = {}
    for block in blocks:
        if block.keyword != "NODE":
            continue
        for line in block.data:
            label, *coordinates = line.entries
            for entry in coordinates[:3]:
                if len(entry) > _COORDINATE_WIDTH:
                    raise InputError(
                        f"{line.location}: the coordinate {entry} has {len(entry)} characters; "
                        f"CalculiX reads {_COORDINATE_WIDTH} and would drop the rest."
                    )
            values = [_number(line, entry, "a coordinate") for entry in coordinates[:3] if entry]
            number = _label(line, label, "a node number")
            nodes[number] = tuple((*values, 0.0, 0.0, 0.0)[:3])
    if not nodes:
        raise InputError(f"{name} has no *NODE block with nodes before its first *STEP.")
    return nodes


def _elements(
    blocks: list[Block], nodes: dict[int, tuple[float, ...]], name: str
) -> tuple[set[int], set[int], tuple[str, ...]]:
    """Numbers of elements and of their nodes, and the elements' types."""
    elements: set[int] = set()
    used: set[int] = set()
    types: list[str] = []
    for block in blocks:
        if block.keyword in _REFUSED:
            raise InputError(f"{block.head.location}: *{block.keyword}: {_REFUSED[block.keyword]}.")
        if block.keyword != "ELEMENT":
            continue
        types.append(block.named("TYPE"))
        if types[-1].startswith("U"):
            raise InputError(f"{block.head.location}: {types[-1]}: {_REFUSED['USER ELEMENT']}.")
        continued, n_nodes = 0, _nodes_of_type(types[-1])
        for line in block.data:
            numbers = [_label(line, e, "a node or element number") for e in line.entries if e]
            members = numbers if continued else numbers[1:]
            if not continued:
                elements.add(numbers[0])
            missing = [number for number in members if number not in nodes]
            if missing:
                raise InputError(
                    f"{line.location}: the element has node {missing[0]}, which no *NODE block has."
                )
            used.update(members)
            continued += len(members)
            if continued >= n_nodes or (n_nodes == 0 and not line.text.endswith(",")):
                continued = 0
    if not used:
        raise InputError(f"{name} has no *ELEMENT block with elements before its first *STEP.")
    return elements, used, tuple(dict.fromkeys(types))


def _nodes_of_type(kind: str) -> int:
    """Nodes per element of a type; zero where only the data lines show it."""
    solids = re.match(r"(?:C3D|S|CPS|CPE|CAX|M3D|DC3D)(\d+)", kind)
    if solids:
        return int(solids[1])
    beams = re.match(r"(?:B|T)(?:2|3)D?(\d)", kind)
    if beams:
        return int(beams[1]) + (0 if kind.startswith("T") else 1)
    return {"MASS": 1, "SPRING1": 1, "SPRING2": 2, "SPRINGA": 2, "DASHPOTA": 2}.get(kind, 0)


def _node_sets(blocks: list[Block]) -> set[str]:
    """Names of the node sets, in capitals."""
    names = {block.named("NSET") for block in blocks if block.keyword in ("NODE", "NSET")}
    return names - {""}


def _check_supports(blocks: list[Block], nodes: set[int], sets: set[str]) -> None:
    for block in blocks:
        if block.keyword != "BOUNDARY":
            continue
        for line in block.data:
            target, *rest = line.entries
            if target.isdigit() and int(target) not in nodes:
                raise InputError(
                    f"{line.location}: the support is at node {target}, which no *NODE block has."
                )
            if not target.isdigit() and target.upper() not in sets:
                raise InputError(f"{line.location}: no node set is called {shown(target)}.")
            value = rest[2] if len(rest) > 2 else ""
            if value and abs(_number(line, value, "a displacement")) > _RIGID_ZERO:
                raise InputError(
                    f"{line.location}: the displacement {value} is prescribed; supports of a "
                    "condensation do not move."
                )


def _check_materials(blocks: list[Block], name: str) -> None:
    keywords = {block.keyword: block for block in reversed(blocks)}
    for lossy in _LOSSY:
        if lossy in keywords:
            raise InputError(
                f"{keywords[lossy].head.location}: *{lossy}: a reduced stiffness has a potential, "
                "so that the material must be elastic (*ELASTIC, *HYPERELASTIC)."
            )
    if not any(keyword in keywords for keyword in _ELASTIC):
        raise InputError(f"{name} has no *ELASTIC or *HYPERELASTIC material.")
    for keyword in ("DENSITY", "ELASTIC"):
        for block in blocks:
            if block.keyword == keyword and block.data:
                line = block.data[0]
                value = _number(line, line.entries[0], "a number")
                if not value > 0:
                    raise InputError(
                        f"{line.location}: *{keyword} must be positive, but is {value:g}."
                    )
    if "DENSITY" not in keywords and "MASS" not in keywords:
        raise InputError(f"{name} has no *DENSITY: modes need a mass.")
