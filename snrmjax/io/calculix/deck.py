"""A user's CalculiX deck: its keyword blocks, its mesh, its checks, and the text of the jobs.

Included files are inserted and comments dropped.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from snrmjax.io.files import FilePath, file_name, read_text, shown
from snrmjax.numerics.rules import InputError

_DEEPEST_INCLUDE = 20
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


class Line(NamedTuple):
    """A line of a deck with its file and line number."""

    text: str
    file: str
    number: int  # in its file, from one

    @property
    def location(self) -> str:
        """File and line number, for messages."""
        return f"{self.file}, line {self.number}"

    @property
    def entries(self) -> list[str]:
        """The comma-separated entries; a trailing comma adds none."""
        parts = [part.strip() for part in self.text.split(",")]
        return parts[:-1] if len(parts) > 1 and not parts[-1] else parts


class Block(NamedTuple):
    """A keyword with its parameters and the data lines below it."""

    keyword: str  # in capitals, without the star
    parameters: dict[str, str]  # names in capitals; a flag has an empty value
    head: Line
    data: tuple[Line, ...]

    def named(self, parameter: str) -> str:
        """The value of a parameter in capitals, as CalculiX compares names, or an empty text."""
        return self.parameters.get(parameter, "").upper()

    @property
    def text(self) -> str:
        """The block as text of a deck."""
        values = [f"{name}={value}" if value else name for name, value in self.parameters.items()]
        rows = [line.text for line in self.data]
        return "\n".join(["*" + ", ".join([self.keyword, *values]), *rows])

    def with_parameters(self, **changed: str | None) -> "Block":
        """With changed parameter values; None removes a parameter."""
        kept = {**self.parameters, **{name: value or "" for name, value in changed.items()}}
        gone = [name for name, value in changed.items() if value is None]
        return self._replace(parameters={n: v for n, v in kept.items() if n not in gone})


def read_blocks(path: FilePath) -> list[Block]:
    """The keyword blocks of a deck, *INCLUDE files inserted.

    Returns the blocks in the order of the deck. Raises `ValueError` where a file is missing or
    includes itself, and for data before the first keyword.
    """
    lines = list(_lines(Path(path), ()))
    blocks: list[Block] = []
    position = 0
    while position < len(lines):
        head = lines[position]
        if not head.text.startswith("*"):
            raise InputError(
                f"{head.location}: {shown(head.text)} comes before the first keyword (*NODE, ...)."
            )
        text = head.text
        while text.endswith(",") and position + 1 < len(lines):  # a keyword on several lines
            position += 1
            text += lines[position].text
        begin = position = position + 1
        while position < len(lines) and not lines[position].text.startswith("*"):
            position += 1
        keyword, *parameters = [part.strip() for part in text[1:].split(",")]
        named = [part.partition("=") for part in parameters if part]
        values = {name.strip().upper(): value.strip() for name, _, value in named}
        keyword = " ".join(keyword.upper().split())
        blocks.append(Block(keyword, values, head, tuple(lines[begin:position])))
    return blocks


def _lines(path: Path, above: tuple[Path, ...]) -> Iterator[Line]:
    """Lines other than blanks and comments, with included files inserted."""
    name = file_name(path)
    for number, raw in enumerate(read_text(path).splitlines(), start=1):
        text = raw.strip()
        if not text or text.startswith("**"):
            continue
        line = Line(text, name, number)
        if text[1:].replace(" ", "").upper().startswith("INCLUDE") and text[0] == "*":
            yield from _included(line, path, (*above, path))
        else:
            yield line


def _included(line: Line, path: Path, above: tuple[Path, ...]) -> Iterator[Line]:
    values = dict(part.split("=", 1) for part in line.text.split(",") if "=" in part)
    given = [
        value.strip().strip('"') for key, value in values.items() if key.strip().upper() == "INPUT"
    ]
    if not given:
        raise InputError(f"{line.location}: *INCLUDE needs INPUT=file.")
    target = path.parent / given[0]
    if target in above or len(above) > _DEEPEST_INCLUDE:
        raise InputError(f"{line.location}: {given[0]} includes itself.")
    if not target.is_file():
        raise InputError(f"{line.location}: the included file {given[0]} does not exist.")
    yield from _lines(target, above)


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
