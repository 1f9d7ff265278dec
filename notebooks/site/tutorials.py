"""The site's tutorials: a page and a notebook to download for every executed notebook.

A hook of MkDocs. Outputs are those that `execute_notebooks.py` has kept; where they are not those
of the present script and package the build warns, which `--strict` makes an error. The comment at
the head of a figure's cell is its alternative text; cells with the tag hide-input are folded. With
TUTORIALS_UNEXECUTED=1 in the environment the pages are made of the scripts alone.
"""

import io
import logging
import os

import jupytext
import nbformat
from execute_notebooks import kept, scripts
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter
from PIL import Image

LOG = logging.getLogger("mkdocs.hooks.tutorials")
UNEXECUTED = "TUTORIALS_UNEXECUTED"
TEMPLATE = """{% extends 'markdown/index.md.j2' %}
{% block input %}
{% set folded = "hide-input" in cell.metadata.get("tags", []) %}
{% if folded %}<details class="code" markdown="1"><summary>Code</summary>{% endif %}

```python
{{ cell.source }}
```

{% if folded %}</details>{% endif %}
{% endblock input %}
{% block stream %}
```text
{{ output.text | trim("\n") }}
```
{% endblock stream %}
{# The sentence before it says why a notebook ended. #}
{% block error %}{% endblock error %}
{% block data_png scoped %}
![{{ cell | description }}]({{ output.metadata.filenames["image/png"] }})
{% endblock data_png %}
"""


def description(cell: nbformat.NotebookNode) -> str:
    """What a figure shows, for who cannot see it: the comment at the head of its cell."""
    said = []
    for line in cell.source.splitlines():
        if not line.startswith("# "):
            break
        said.append(line.removeprefix("# "))
    if not said:
        raise PluginError(f"A figure's cell begins without a comment on it:\n{cell.source}")
    return " ".join(said).replace("[", "(").replace("]", ")")


def page(notebook: nbformat.NotebookNode, name: str) -> tuple[str, dict[str, bytes]]:
    """The page of a notebook in Markdown, and its figures by their names."""
    exporter = MarkdownExporter(raw_template=TEMPLATE, filters={"description": description})
    text, resources = exporter.from_notebook_node(
        notebook, {"unique_key": name, "output_files_dir": "figures"}
    )
    figures = {}
    for path, png in (resources["outputs"] or {}).items():
        smaller = io.BytesIO()
        Image.open(io.BytesIO(png)).convert("RGB").save(smaller, "webp", lossless=True, method=6)
        figures[path.replace(".png", ".webp")] = smaller.getvalue()
        text = text.replace(f"({path})", f"({path.replace('.png', '.webp')})")
    title, rest = text.lstrip().split("\n", 1)
    link = f"[Download this page as a notebook]({name}.ipynb)"
    return f"{title}\n\n{link}\n{rest}", figures


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
        text, figures = page(notebook, script.stem)
        made: dict[str, str | bytes] = {f"{script.stem}.md": text, **figures}
        made[f"{script.stem}.ipynb"] = nbformat.writes(notebook)
        for path, content in made.items():
            files.append(File.generated(config, f"tutorials/{path}", content=content))
    return files
