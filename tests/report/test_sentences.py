"""One snapshot of all sentences: `told.json` has of every kind of fact an example and its wording.

After a change of words, `python tests/report/test_sentences.py` writes the file anew, to be read.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import snrmjax  # noqa: F401 - registers the sentences
from snrmjax.numerics.facts import Fact
from snrmjax.report.sentences import sentence, wordings

TOLD = Path(__file__).with_name("told.json")


def as_value(of):
    """A value from JSON: facts have a kind, statuses a message, lists are tuples."""
    if isinstance(of, list):
        return tuple(map(as_value, of))
    if not isinstance(of, dict):
        return of
    if "status" in of:
        return SimpleNamespace(message=of["status"])
    values = {key: as_value(value) for key, value in of.items() if key != "fact"}
    return Fact(of["fact"], **values) if "fact" in of else values


def told_now(told):
    return {kind: [values, sentence(as_value(values))] for kind, (values, _) in told.items()}


def test_every_kind_has_an_example_that_is_worded_as_it_was():
    told = json.loads(TOLD.read_text(encoding="utf-8"))
    assert {kind: words for kind, (_, words) in told_now(told).items()} == {
        kind: words for kind, (_, words) in told.items()
    }
    assert set(told) == set(wordings())


if __name__ == "__main__":
    known = json.loads(TOLD.read_text(encoding="utf-8"))
    text = json.dumps(told_now(known), ensure_ascii=False, indent=1)
    TOLD.write_text(text + "\n", encoding="utf-8")
