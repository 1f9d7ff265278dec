"""Every notebook runs to its end, checks its own headline, and makes a page with its figures."""

import re
from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
PATHS = [pytest.param(path, id=path.stem) for path in sorted(NOTEBOOKS.glob("*.py"))]
IMAGE = re.compile(r"!\[([^\]]*)\]\(([^)]*)\)")


@pytest.fixture(autouse=True)
def site(monkeypatch):
    """What makes the site's tutorials stands beside its pages, in no package."""
    monkeypatch.syspath_prepend(NOTEBOOKS / "site")


@pytest.mark.long
@pytest.mark.parametrize("path", PATHS)
def test_it_runs_to_its_end_and_makes_a_page(path, monkeypatch):
    from execute_notebooks import execute
    from tutorial_page import tutorial_page

    monkeypatch.setenv("STUDY_MEMBERS", "128")
    notebook = execute(path)
    streams = [o for c in notebook.cells for o in c.get("outputs", []) if o.output_type == "stream"]
    told = "".join(output.text for output in streams)
    assert [output.text for output in streams if output.name == "stderr"] == []
    if notebook.metadata["snrmjax"]["ended_early"]:
        pytest.skip(told)  # measured data are not there, as it says
    assert "\nyes  " in told, "the notebook checks nothing"
    assert "\nNO   " not in told
    text, figures = tutorial_page(notebook, path.stem)
    images = IMAGE.findall(text)
    assert images, "the notebook draws nothing"
    assert sorted(where for _, where in images) == sorted(figures)
    assert all(len(said) > 30 for said, _ in images)
    assert "<Figure" not in text, "a figure is shown as text"
    assert sum(map(len, figures.values())) < 1_000_000


def test_a_page_keeps_equations_and_says_what_figures_show():
    import jupytext
    from execute_notebooks import NOTEBOOKS as where
    from tutorial_page import tutorial_page

    assert where == NOTEBOOKS
    notebook = jupytext.reads(
        "# %% [markdown]\n# # Title\n#\n# $$x_1^2$$\n\n"
        '# %% tags=["hide-input"]\n# A line that rises.\nfigure\n\n# %%\nprint(1)\n',
        "py:percent",
    )
    pixel = (
        "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5E"
        "rkJggg=="
    )
    notebook.cells[1].outputs = [nbformat.v4.new_output("display_data", {"image/png": pixel})]
    notebook.cells[2].outputs = [nbformat.v4.new_output("stream", text="1\n")]
    text, figures = tutorial_page(notebook, "00_title")
    assert text.startswith("# Title\n\n[Download this page as a notebook](00_title.ipynb)\n")
    assert "$$x_1^2$$" in text
    ((said, where),) = IMAGE.findall(text)
    assert said == "A line that rises."
    assert figures[where].startswith(b"RIFF")
    assert "```text\n1\n```" in text
    assert text.count("<details") == 1
    assert text.count("A line that rises.") == 1
    notebook.cells[1].source = "figure"
    with pytest.raises(ValueError, match="without a comment"):
        tutorial_page(notebook, "00_title")


def test_outputs_of_another_script_are_not_kept(tmp_path, monkeypatch):
    import execute_notebooks as tool

    monkeypatch.setattr(tool, "EXECUTED", tmp_path)
    script = tmp_path / "00_short.py"
    script.write_text("# %%\nprint(6 * 7)\n\n# %%\nraise SystemExit\n\n# %%\n1 / 0\n", "utf-8")
    assert tool.kept(script) is None
    nbformat.write(tool.execute(script), tmp_path / "00_short.ipynb")
    notebook = tool.kept(script)
    assert notebook.cells[0].outputs[0].text == "42\n"
    assert notebook.metadata["snrmjax"]["ended_early"]
    script.write_text("# %%\nprint(6 * 8)\n", "utf-8")
    assert tool.kept(script) is None
