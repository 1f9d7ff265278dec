"""What a release states of itself, in all its places."""

import re
import tomllib
from pathlib import Path

import snrmjax

TOP = Path(__file__).resolve().parents[1]


def test_the_version_is_the_same_everywhere():
    stated = re.search(r"^version: (.+)$", (TOP / "CITATION.cff").read_text(), re.MULTILINE)
    assert stated is not None
    assert stated[1] == snrmjax.__version__


def test_all_extras_are_in_one():
    extras = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (every,) = extras["all"]
    named = set(re.findall(r"[a-z]+", every.partition("[")[2]))
    assert named == set(extras) - {"all", "docs", "lint", "test"}


def test_types_are_shipped():
    assert (Path(snrmjax.__file__).parent / "py.typed").is_file()
