"""Facts, their sentences, and statuses: every kind has a wording, every status a message."""

import ast
import functools
import importlib
import inspect
import pkgutil
import string
from pathlib import Path

import pytest

import snrmjax
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.status import Status
from snrmjax.report.sentences import sentence, wordings

PACKAGE = Path(snrmjax.__file__).parent


@functools.cache
def stated_facts():
    """Every `Fact("kind", name=…)` of the package: location, kind, names of values."""
    facts = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Fact":
                location = f"{path.relative_to(PACKAGE)}:{node.lineno}"
                assert isinstance(node.args[0], ast.Constant), f"{location}: a kind is a constant"
                names = {keyword.arg for keyword in node.keywords}
                facts.append((location, node.args[0].value, names))
    return facts


def test_every_fact_is_worded_from_values_that_it_has():
    stated, words = stated_facts(), wordings()
    assert stated
    for location, kind, names in stated:
        file = f"snrmjax/report/sentences/{location.partition('/')[0]}.py"
        assert kind in words, f"{location}: {kind!r} has no entry in `SENTENCES` of {file}"
        if None in names:  # values given as a mapping
            continue
        wording = words[kind]
        if callable(wording):
            inspect.signature(wording).bind(**dict.fromkeys(names))
            continue
        fields = {
            piece.partition(".")[0].partition("[")[0]
            for _, piece, _, _ in string.Formatter().parse(wording)
            if piece is not None
        }
        assert fields <= names, f"{location}: {kind!r} is worded with {fields - names}"


def test_no_sentence_without_a_fact():
    assert set(wordings()) == {kind for _, kind, _ in stated_facts()}


def test_templates_count_list_and_print_percentages(monkeypatch):
    table = {"example": "{n:#state} of levels {levels}, {fraction:%.2g}"}
    monkeypatch.setattr("snrmjax.report.sentences.wordings", lambda: table)
    fact = Fact("example", n=1, levels=(1, 2, 5), fraction=0.0512)
    assert sentence(fact) == str(fact) == "1 state of levels 1, 2 and 5, 5.1 %"


def test_a_fact_without_a_wording_names_kind_and_file(monkeypatch):
    with pytest.raises(LookupError, match=r"'unheard_of' has no wording.*snrmjax/report/sentences"):
        str(Fact("unheard_of"))
    monkeypatch.setattr("snrmjax.report.sentences.wordings", lambda: {"example": "{n} rows"})
    with pytest.raises(LookupError, match=r"'example' is worded with 'n', but has \['m'\]"):
        str(Fact("example", m=1))


def test_facts_compare_and_hash_by_kind_and_values():
    assert Fact("a", level=1) == Fact("a", level=1) != Fact("a", level=2)
    assert len({Fact("a", level=1), Fact("a", level=1), Fact("b", level=1)}) == 2
    assert Fact("a", level=1) != "a"


def test_every_status_has_a_message_of_its_own():
    for module in pkgutil.walk_packages(snrmjax.__path__, "snrmjax."):
        if not any(part in module.name for part in (".report", ".cli", "__main__")):
            importlib.import_module(module.name)
    kinds = Status.__subclasses__()
    assert kinds
    for kind in kinds:
        messages = [member.message for member in kind]
        assert all(messages)
        assert len(set(messages)) == len(messages), kind
    with pytest.raises(ValueError, match="is not a valid"):
        kinds[0](99)
