"""The arrows of the house: who imports whom, and what no numerical module may touch."""

import ast
import itertools
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "snrmjax"

# What each room may import beside itself. Whatever is not here stands on the roof.
ROOMS = {
    "numerics": set(),
    "model": {"numerics"},
    "measure": {"numerics", "model"},
    "simulate": {"numerics", "model", "measure"},
    # Finite elements to reduced models: the linear and polynomial structures of `model`.
    "condense": {"numerics", "model", "simulate"},
    "identify": {"numerics", "model", "measure", "simulate"},
    # Other methods on the same data, ours among them.
    "methods": {"numerics", "model", "measure", "simulate", "identify"},
    "diagnose": {"numerics", "model", "measure", "simulate", "identify"},
    # Looks at tables and records before anything is identified.
    "doctor": {"numerics", "model", "measure", "identify"},
    # Files are on the roof: they hold what the numerical rooms find.
    "io": {
        *("numerics", "model", "measure", "simulate", "condense", "identify", "diagnose"),
        "doctor",
    },
    "study": {
        *("numerics", "model", "measure", "simulate", "condense", "identify", "diagnose", "io"),
    },
    # What a command does, as verbs that return plain results.
    "pipelines": {
        *("numerics", "model", "measure", "simulate", "condense", "identify", "diagnose"),
        *("methods", "doctor", "io"),
    },
    "report": {
        *("numerics", "model", "measure", "simulate", "condense", "identify", "diagnose"),
        *("methods", "doctor", "io", "study", "pipelines"),
    },
}
# Within a room: what each sub-room may import beside itself. A module beside the sub-rooms may
# import all of them; none of them imports it, unless it is named here.
SUB_ROOMS = {
    "model.library": {
        *(
            "model.effect_base",
            "model.effect_metadata",
            "model.nonsmooth_points",
            "model.modes",
            "model.potential",
        ),
    },
    "measure.recordings": {"measure.signals", "measure.states"},
    # One mode of a free decay, separated from interfering modes.
    "measure.decays": {"measure.recordings", "measure.signals", "measure.states"},
    "measure.sweeps": {"measure.recordings", "measure.signals", "measure.states"},
    "simulate.balance": set(),
    "simulate.continuation": {"simulate.balance"},
    "simulate.solutions": {"simulate.balance", "simulate.continuation"},
    "simulate.virtual_test": {
        *("simulate.balance", "simulate.continuation", "simulate.solutions"),
    },
    "identify.curves": set(),
    "identify.pointwise": {"identify.checks", "identify.curves"},
    "identify.checks": set(),
    "identify.joint": {
        *("identify.checks", "identify.curves", "identify.pointwise", "identify.test_model"),
    },
    "identify.prediction": {
        *("identify.curves", "identify.pointwise", "identify.joint", "identify.test_model"),
    },
    "identify.inference": {
        *("identify.curves", "identify.pointwise", "identify.joint", "identify.prediction"),
        "identify.test_model",
    },
    "identify.calibrate": {"identify.pointwise"},
    "identify.coupled": {"identify.calibrate", "identify.inference"},
    "identify.modal": set(),
    "identify.scaling": {"identify.modal"},
    "methods.steady": {"methods.result", "methods.one_sensor"},
    "methods.records": {"methods.result", "methods.one_sensor"},
    "identify.test_model": {"identify.checks", "identify.curves"},
    # What a diagnosis knows of every kind of effect.
    "diagnose.kinds": {"diagnose.priors", "diagnose.readings"},
    "diagnose.misfit": {"diagnose.priors", "diagnose.kinds"},
    "diagnose.naming": {"diagnose.priors", "diagnose.readings", "diagnose.kinds"},
    "diagnose.checks": {"diagnose.misfit", "diagnose.priors"},
    "diagnose.location": {"diagnose.misfit"},
    "io.calculix": {"io.files"},
    "io.laboratory": {"io.files", "io.rows"},
    "io.exchange": {
        *("io.files", "io.columns", "io.rows", "io.tables", "io.toml_table"),
        "io.laboratory",
    },
    "report.figures": {
        *("report.style", "report.html", "report.sampling", "report.sentences"),
    },
    "report.pages": {
        *("report.figures", "report.style", "report.html", "report.sampling"),
        *("report.parameters", "report.sentences"),
    },
    "report.sentences": set(),
    "report.study": {"report.style", "report.html", "report.sentences"},
    "io.programs": {"io.files"},
    "model.builders": {
        *("model.moving_base", "model.effect_base", "model.effects", "model.modes"),
        *("model.attachment", "model.potential", "model.structures"),
    },
    "io.reduction": {
        *("io.columns", "io.files", "io.rows", "io.tables", "io.toml_table"),
    },
    "diagnose.design": {"diagnose.misfit", "diagnose.fitted_effects", "diagnose.priors"},
    "condense.elements": {"condense.load_cases"},
    # A study is made of computations, which know nothing of where and how often they run.
    "study.computations": set(),
    "study.uncertainty": {"study.variations"},
    "study.analysis": {"study.computations", "study.uncertainty"},
}
NUMERICAL = set(ROOMS) - {"io", "study", "pipelines", "report"}
MOST_MODULES = 13
# The top of the package gives names to users; rooms name the module they mean.
PUBLIC = "the package itself"

DRAWING_AND_COMMANDS = {"matplotlib", "typer", "rich", "jinja2", "click"}
FILE_FORMATS = {
    *("csv", "json", "pickle", "tomllib", "tomli_w", "yaml", "zipfile", "sqlite3"),
    *("h5py", "h5netcdf", "netCDF4", "xarray", "pandas", "openpyxl", "pyuff", "pymatreader"),
    *("scipy.io", "platformdirs"),
}
LABELLED = "snrmjax.numerics.result"
LONGEST = 450
# Rules about effects stand in the classes of effects: no other room knows an effect by its kind.
KINDS = {
    kind
    for path in (PACKAGE / "model" / "library").glob("*.py")
    for kind in re.findall(r'kind: ClassVar\[str\] = "(\w+)"', path.read_text(encoding="utf-8"))
}
# The contract calls what the doctor finds in a record of the force by the name of an effect: in
# its list of findings this text means the finding.
FINDINGS = {("snrmjax.doctor.findings", "force_harmonics")}
KIND = re.compile(r"\b(" + "|".join(sorted(KINDS)) + r")\b")


def imported_modules(tree, module, *, is_package):
    """(line, full dotted name) of everything a module imports, wherever in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = module.split(".")
            up = node.level - is_package if node.level else 0
            base = parts[: len(parts) - up] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{stem}.{alias.name}") for alias in node.names)


def room_of(module):
    """The room a dotted name of the package is in: its first part after the package's name."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else PUBLIC


def sub_room_of(module):
    """`room.sub_room` of a dotted name of the package, or None where it is in no sub-room."""
    name = ".".join(module.split(".")[1:3])
    return name if name in SUB_ROOMS else None


def climbs(module, name):
    """Whether a module imports what stands above it in its own room."""
    own, target = sub_room_of(module), ".".join(name.split(".")[1:3])
    if own is None or room_of(name) != room_of(module) or target == own:
        return False
    return target not in SUB_ROOMS[own]


def begins(name, prefixes):
    """Whether a dotted name is one of the prefixes or inside it."""
    return any(name == prefix or name.startswith(prefix + ".") for prefix in prefixes)


def violations(module, source, *, rooms, is_package=False):
    """What one module does against the house; `rooms` are the names at the package's top."""
    tree, room = ast.parse(source), room_of(module)
    found = []
    for line, name in imported_modules(tree, module, is_package=is_package):
        where = f"{module}:{line}"
        if begins(name, {"snrmjax"}) and name != "snrmjax.__version__":  # a fact, no room
            # `from snrmjax import forced_response` names no room: a public name of the top.
            target = room_of(name) if room_of(name) in rooms else PUBLIC
            if room in ROOMS and target != room and target not in ROOMS[room]:
                found.append(f"{where}: {room} imports {name}")
            elif climbs(module, name):
                found.append(f"{where}: {sub_room_of(module)} imports {name}")
        elif room in NUMERICAL and begins(name, DRAWING_AND_COMMANDS | FILE_FORMATS):
            if module == LABELLED and begins(name, {"xarray", "pandas", "matplotlib.figure"}):
                continue  # what every result's `to_xarray` gives, imported where it is asked for
            found.append(f"{where}: the numerical room {room} imports {name}")
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):
            found.append(f"{module}:{node.lineno}: an assert statement")
        if isinstance(node, ast.ExceptHandler) and node.type is None:
            found.append(f"{module}:{node.lineno}: a bare except")
    found += [
        f"{module}:{line}: the kind {kind!r} of an effect" for line, kind in kinds(module, tree)
    ]
    length = len(source.splitlines())
    if length > LONGEST:
        found.append(f"{module}: {length} lines, more than {LONGEST}")
    return found


def kinds(module, tree):
    """(line, kind) of every effect that a module outside the model knows by its kind.

    In a text of its code; in the diagnosis in docstrings and as a name too.
    """
    if room_of(module) == "model":
        return
    strict = room_of(module) == "diagnose"
    docs = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr) and not strict]
    for node in ast.walk(tree):
        words = [node.value] if isinstance(node, ast.Constant) and node not in docs else []
        if strict:
            words += [getattr(node, part, None) for part in ("id", "attr", "arg", "name")]
        for word in words:
            if isinstance(word, str) and (module, word) not in FINDINGS:
                yield from ((node.lineno, kind) for kind in KIND.findall(word))


def package_modules():
    """(dotted name, file, whether it is a package) of all of snrmjax."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("snrmjax", *path.relative_to(PACKAGE).with_suffix("").parts)
        is_package = parts[-1] == "__init__"
        yield ".".join(parts[:-1] if is_package else parts), path, is_package


MODULES = list(package_modules())
TOP = {room_of(module) for module, _, _ in MODULES} - {PUBLIC}


def test_every_module_keeps_the_house():
    found = [
        one
        for module, path, is_package in MODULES
        for one in violations(
            module, path.read_text(encoding="utf-8"), rooms=TOP, is_package=is_package
        )
    ]
    assert found == []


def test_the_rooms_are_there_and_all_files_are_seen():
    assert set(ROOMS) <= TOP
    assert TOP - set(ROOMS) <= {"cli", "plot", "__main__"}
    assert set(SUB_ROOMS) == {
        ".".join(p.relative_to(PACKAGE).parts)
        for p in PACKAGE.glob("*/*")
        if (p / "__init__.py").exists()
    }
    for room in {path.parent for _, path, _ in MODULES}:
        assert len(list(room.glob("[!_]*.py"))) <= MOST_MODULES, room
    assert len(MODULES) == len(list(PACKAGE.rglob("*.py"))) > 30
    for room, below in ROOMS.items():  # downwards only: nobody is below itself
        assert room not in set(itertools.chain(below, *(ROOMS[b] for b in below)))
    for room, below in SUB_ROOMS.items():
        assert room not in set(itertools.chain(below, *(SUB_ROOMS.get(b, ()) for b in below)))


def test_each_public_name_is_defined_once():
    places = {}
    for module, path, _ in MODULES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and node.name[0] != "_":
                places.setdefault(node.name, []).append(module)
    assert len(places) > 300
    twice = {name: where for name, where in places.items() if len(where) > 1}
    # Every page has both.
    for name in ("write", "headline"):
        assert all(module.startswith("snrmjax.report.pages.") for module in twice.pop(name))
    assert twice == {}


def test_no_public_name_is_a_module_beside_it():
    """Once such a module is imported, its package's attribute is the module, not the function."""
    stubs, clashes = list(PACKAGE.rglob("__init__.pyi")), []
    for stub in stubs:
        for node in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                names = {alias.asname or alias.name for alias in node.names}
                clashes += [stub.parent / name for name in names if stub.with_name(name).exists()]
                clashes += [
                    path for name in names if (path := stub.with_name(f"{name}.py")).exists()
                ]
    assert len(stubs) > 5
    assert clashes == []


BROKEN = {
    "snrmjax.model.modes": [
        ("from snrmjax.measure.states import SteadyStates", "model imports"),
        (
            "import snrmjax.simulate.balance.harmonics",
            "model imports snrmjax.simulate.balance.harmonics",
        ),
        ("from ..io import tables", "model imports snrmjax.io.tables"),
        ("from .. import report", "model imports snrmjax.report"),
        ("def late():\n    from snrmjax.cli import main", "model imports snrmjax.cli.main"),
        ("from snrmjax import forced_response", "model imports snrmjax.forced_response"),
        ("import snrmjax", "model imports snrmjax"),
        ("import matplotlib.pyplot as plt", "numerical room model imports matplotlib.pyplot"),
        ("from scipy.io import loadmat", "numerical room model imports scipy.io.loadmat"),
        ("from scipy import io", "numerical room model imports scipy.io"),
        ("import tomllib, math", "numerical room model imports tomllib"),
        ("assert True", "an assert statement"),
        ("try:\n    pass\nexcept:\n    pass", "a bare except"),
        ("\n" * (LONGEST + 1), "more than 450"),
    ],
    "snrmjax.model.library.friction": [
        ("from snrmjax.model.effects import EFFECTS", "model.library imports"),
        ("from snrmjax.model.effect_base import AbstractForce", ""),
    ],
    "snrmjax.measure.signals": [("from snrmjax.simulate import harmonics", "measure imports")],
    "snrmjax.simulate": [("from .identify import inversion", "")],  # inside the room: allowed
    "snrmjax.simulate.virtual_test.recording": [
        ("from snrmjax.identify.pointwise.snrm import f", "simulate imports"),
        ("from snrmjax.simulate.balance.harmonics import f", ""),
    ],
    "snrmjax.simulate.balance.harmonics": [
        ("from snrmjax.simulate.continuation.events import f", "simulate.balance imports"),
        ("from snrmjax.simulate.balance.prescribed_motion import f", ""),
    ],
    "snrmjax.identify.joint.selection": [
        ("from snrmjax.identify.inference import fitted_curves", "identify.joint imports"),
        ("from snrmjax.diagnose import search", "identify imports"),
    ],
    "snrmjax.diagnose.checks.doubts": [
        ('if kind == "cubic_damping":\n    pass', "the kind 'cubic_damping' of an effect"),
        ('"""What one_sided_stop does."""', "the kind 'one_sided_stop' of an effect"),
        ("def found(gap_stiffness):\n    pass", "the kind 'gap_stiffness' of an effect"),
        ("NAMES = {'close_mode.frequency_hz': 1}", "the kind 'close_mode' of an effect"),
        ("from snrmjax.model.effects import EFFECTS", ""),
    ],
    "snrmjax.report.sampling": [
        ("NAME = 'added_mass'", "the kind 'added_mass' of an effect"),
        ("def force_harmonics():\n    pass", ""),  # of a record: another thing of that name
        ('"""As an example: added_mass."""', ""),
    ],
    "snrmjax.diagnose.misfit.programs": [
        ("from snrmjax.diagnose.diagnosis import Diagnosis", "diagnose.misfit imports"),
    ],
    "snrmjax.io.tables": [
        ("from snrmjax.report.figures.identification import save_figure", "io imports"),
        ("import csv, tomllib", ""),  # files are its business
    ],
    "snrmjax.cli": [("import typer\nfrom snrmjax.identify import snrm", "")],  # the roof may
}


def test_the_kinds_are_those_of_the_library():
    from snrmjax.model.effects import known_effects

    assert {*known_effects()} == KINDS


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [(module, source, text) for module, cases in BROKEN.items() for source, text in cases],
)
def test_the_check_sees_a_violation(module, source, complaint):
    rooms = TOP
    found = violations(module, source, rooms=rooms, is_package=module.count(".") == 1)
    if not complaint:
        assert found == []
    else:
        assert len(found) == 1
        assert complaint in found[0]
