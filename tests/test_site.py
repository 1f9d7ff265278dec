"""The documentation site: its pages' commands run as they stand, and no public name is left out."""

import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest

SITE = Path(__file__).resolve().parents[1] / "notebooks" / "site"
PAGES = sorted((SITE / "pages").rglob("*.md"))
FENCE = re.compile(r"^```(\{[^}\n]*\}|\w*)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.M | re.S)
NUMBER = re.compile(r"-?\d[\d.]*(?:e[-+]?\d+)?")
RUN = [page for page in PAGES if re.search(r"^```(sh|python)", page.read_text("utf-8"), re.M)]


def worded(text):
    """Lines without their numbers, which differ in the last digits between machines."""
    return [NUMBER.sub("#", line.strip()) for line in text.splitlines()]


@pytest.mark.long
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_commands_of_a_page_run_and_say_what_it_shows(page, tmp_path):
    # Blocks with a title are files; `sh` and `python` run in order; `text` is what was printed.
    program = tmp_path / "bin" / "snrmjax"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m snrmjax "$@"\n')
    program.with_name("python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    for one in program.parent.iterdir():
        one.chmod(one.stat().st_mode | stat.S_IXUSR)
    work = tmp_path / "work"
    work.mkdir()
    path = f"{program.parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "MPLBACKEND": "agg", "COLUMNS": "200"}
    told = ""
    for language, title, content in FENCE.findall(page.read_text("utf-8")):
        if title:
            (work / title).write_text(content, "utf-8")
        if language == "text":
            missing = [line for line in worded(content) if line not in worded(told)]
            assert not missing, f"not printed: {missing}\n\n{told}"
        if language not in ("sh", "python"):
            continue
        command = ["bash", "-euc", content] if language == "sh" else [sys.executable, "-c", content]
        done = subprocess.run(
            command, cwd=work, env=environment, capture_output=True, text=True, timeout=600
        )
        told = done.stdout + done.stderr
        assert done.returncode == 0, told


def test_every_page_is_in_the_navigation():
    navigation = (SITE / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
    for page in PAGES:
        assert page.relative_to(SITE / "pages").as_posix() in navigation


def test_every_notebook_has_a_tutorial():
    navigation = (SITE / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
    for script in SITE.parent.glob("*.py"):
        assert f"tutorials/{script.stem}.md\n" in navigation
