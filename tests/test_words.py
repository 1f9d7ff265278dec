"""The field's words: names and texts use those of the glossary, and none of the retired ones."""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

import snrmjax as sj
from snrmjax.model.modes import OptionalModalData

PACKAGE = Path(__file__).resolve().parents[1] / "snrmjax"
PAGES = Path(__file__).resolve().parents[1] / "notebooks" / "site" / "pages"

# Former words: the glossary has what to use instead.
RETIRED = {
    *("share", "shares", "bends", "arms", "pulls", "walk", "walked", "company", "confusion"),
    *("confusions", "imitation", "doubt", "doubts", "judged", "tempered", "whereabouts", "kink"),
    *("kinks", "kinked", "tell", "tells", "told", "said", "beside"),
}
# In texts "to share" is a verb and no part of a whole.
IN_TEXTS = RETIRED - {"share", "shares"}
# Names of others, former ones, and arguments of public functions that keep their names.
KEPT = {"walk_packages", "walk_tb", "share_frequencies", "doubts"}


def words_of(name):
    """The parts of an identifier."""
    return [part.lower() for part in re.split(r"_|(?<=[a-z])(?=[A-Z])", name) if part]


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=str)
def test_names_are_the_fields(path):
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    names = {token.string for token in tokens if token.type == tokenize.NAME} - KEPT
    assert not [name for name in names if RETIRED & {*words_of(name)}]


def test_texts_are_the_fields():
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                prose = re.sub(r"`[^`]*`", "", node.value)
                words = IN_TEXTS & {*re.findall(r"[a-z]+", prose.lower())}
                found += [(path.name, node.lineno, word) for word in words if " " in prose]
    for path in [*sorted(PAGES.rglob("*.md")), PACKAGE.parent / "README.md"]:
        prose = re.sub(r"```.*?```|`[^`]*`|{{.*?}}", "", path.read_text(), flags=re.S)
        words = IN_TEXTS & {*re.findall(r"[a-z]+", prose.lower())}
        found += [(path.name, 0, word) for word in words]
    assert not found


@pytest.mark.parametrize(
    ("room", "former", "present"),
    [
        (sj.model, "AbstractKinked", "AbstractNonsmooth"),
        (sj.diagnose, "Whereabouts", "Localisation"),
    ],
)
def test_a_former_name_is_the_present_one_with_a_warning(room, former, present):
    with pytest.warns(DeprecationWarning, match=present):
        assert getattr(room, former) is getattr(room, present)
    with pytest.raises(AttributeError):
        getattr(room, former + "s")


@pytest.mark.parametrize("former", ["Confounder", "Confusion"])
def test_a_former_name_may_be_in_another_room(former):
    with pytest.warns(DeprecationWarning, match="is now snrmjax.diagnose.Confounder"):
        assert getattr(sj.model, former) is sj.diagnose.Confounder


def test_former_attributes_and_arguments_are_the_present_ones_with_a_warning():
    spring = sj.model.EFFECTS["cubic_stiffness"](1.0)
    with pytest.warns(DeprecationWarning, match="AbstractForce.influence_vectors"):
        assert spring.rows == spring.influence_vectors == (None,)
    optional = OptionalModalData(points={"root": [0.5]})
    with pytest.warns(DeprecationWarning, match="`beside` of linear_modes is now `optional`"):
        modes = sj.model.linear_modes([1.0], [0.01], [[1.0]], [1.0], beside=optional)
    assert modes.shape_at("root") == 0.5


def test_former_attributes_of_own_classes_are_read_with_a_warning():
    with pytest.warns(DeprecationWarning, match="Own.nonlinear_parameters"):

        class Own(sj.identify.OwnFamily):
            numbers = {"speed": (0.1,)}  # noqa: RUF012

    assert Own.nonlinear_parameters == {"speed": (0.1,)}


def test_refusals_have_a_class_of_their_own():
    """What NumPy or JAX raise is then no refusal."""
    assert not [path for path in PACKAGE.rglob("*.py") if "raise ValueError" in path.read_text()]
