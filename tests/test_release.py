"""What a release states of itself, in all its places."""

import re
import tomllib
from pathlib import Path

import yaml

import snrmjax

TOP = Path(__file__).resolve().parents[1]
CONDA_NAMES = {"matplotlib": "matplotlib-base", "lazy-loader": "lazy_loader"}


def test_the_version_is_the_same_everywhere():
    stated = re.search(r"^version: (.+)$", (TOP / "CITATION.cff").read_text(), re.MULTILINE)
    assert stated is not None
    assert stated[1] == snrmjax.__version__


def test_the_conda_recipe_asks_for_the_same():
    project = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((TOP / ".conda/recipe.yaml").read_text())
    assert recipe["context"]["version"] == snrmjax.__version__
    parts = [re.fullmatch(r"([\w-]+)(.*)", one).groups() for one in project["dependencies"]]
    wanted = {f"{CONDA_NAMES.get(name, name)} {limits}" for name, limits in parts}
    assert set(recipe["requirements"]["run"]) == wanted | {f"python {project['requires-python']}"}


def test_all_extras_are_in_one():
    extras = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (every,) = extras["all"]
    named = set(re.findall(r"[a-z]+", every.partition("[")[2]))
    assert named == set(extras) - {"all", "docs", "lint", "test"}


def test_types_are_shipped():
    assert (Path(snrmjax.__file__).parent / "py.typed").is_file()
