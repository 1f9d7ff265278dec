"""One snapshot of sentences: each line of `told.jsonl` is a wording and the fact that it words.

The facts are what the tests of the package met. After a change of words,
`python tests/report/test_sentences.py` writes the wordings anew, to be read.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import snrmjax  # noqa: F401 - registers the sentences
from snrmjax.numerics.facts import Fact
from snrmjax.report.sentences import sentence, wordings

TOLD = Path(__file__).with_name("told.jsonl")


def told():
    """Every wording with its fact, as the file has them."""
    return [json.loads(line) for line in TOLD.read_text(encoding="utf-8").splitlines()]


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


def test_facts_are_worded_as_they_were():
    for words, fact in told():
        assert sentence(as_value(fact)) == words


def test_most_kinds_are_there():
    kinds = {fact["fact"] for _, fact in told()}
    assert kinds <= set(wordings())
    assert len(kinds) > 0.7 * len(wordings())


if __name__ == "__main__":
    lines = [json.dumps([sentence(as_value(fact)), fact], ensure_ascii=False) for _, fact in told()]
    TOLD.write_text("\n".join(lines) + "\n", encoding="utf-8")
