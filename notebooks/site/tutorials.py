"""The site's tutorials: a page and a notebook to download for every executed notebook.

A hook of MkDocs. Outputs are those that `execute_notebooks.py` has kept; where they are not those
of the present script and package the build warns, which `--strict` makes an error. With
TUTORIALS_UNEXECUTED=1 in the environment the pages are made of the scripts alone.
"""

import logging
import os

import jupytext
import nbformat
from execute_notebooks import kept, scripts
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from tutorial_page import tutorial_page

LOG = logging.getLogger("mkdocs.hooks.tutorials")
UNEXECUTED = "TUTORIALS_UNEXECUTED"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages, their figures and the notebooks."""
    for script in scripts():
        notebook = kept(script)
        if notebook is None and os.environ.get(UNEXECUTED) != "1":
            LOG.warning(
                "%s has no outputs of its present script and package: run "
                "`python notebooks/site/execute_notebooks.py` (minutes), or set %s=1 for pages "
                "without outputs.",
                *(script.name, UNEXECUTED),
            )
        notebook = notebook or jupytext.read(script)
        text, figures = tutorial_page(notebook, script.stem)
        made: dict[str, str | bytes] = {f"{script.stem}.md": text, **figures}
        made[f"{script.stem}.ipynb"] = nbformat.writes(notebook)
        for path, content in made.items():
            files.append(File.generated(config, f"tutorials/{path}", content=content))
    return files
