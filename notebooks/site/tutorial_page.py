"""A notebook with its outputs as a page in Markdown.

The comment at the head of a figure's cell is its alternative text; cells with the tag hide-input
are folded.
"""

import io

import nbformat
from execute_notebooks import DPI
from nbconvert import MarkdownExporter
from PIL import Image

TEMPLATE = """{% extends 'markdown/index.md.j2' %}
{% block input %}
{% set folded = "hide-input" in cell.metadata.get("tags", []) %}
{% if folded %}<details class="code" markdown="1"><summary>Code</summary>{% endif %}

```python
{{ cell | code }}
```

{% if folded %}</details>{% endif %}
{% endblock input %}
{% block stream %}
```text
{{ output.text | trim("\n") }}
```
{% endblock stream %}
{% block data_png scoped %}
![{{ cell | description }}]({{ output.metadata.filenames["image/png"] }})
{% endblock data_png %}
"""


def split(cell: nbformat.NotebookNode) -> tuple[str, str]:
    """The comment at the head of a cell, without its marks, and the code below it."""
    lines = cell.source.splitlines()
    count = next((k for k, line in enumerate(lines) if not line.startswith("# ")), len(lines))
    return " ".join(line[2:] for line in lines[:count]), "\n".join(lines[count:])


def description(cell: nbformat.NotebookNode) -> str:
    """What a figure shows, for who cannot see it."""
    said, _ = split(cell)
    if not said:
        raise ValueError(f"A figure's cell begins without a comment on it:\n{cell.source}")
    return said.replace("[", "(").replace("]", ")")


def code(cell: nbformat.NotebookNode) -> str:
    """What a page shows of a cell: not the comment that describes a figure."""
    draws = any("image/png" in output.get("data", {}) for output in cell.outputs)
    return split(cell)[1] if draws else cell.source


def tutorial_page(notebook: nbformat.NotebookNode, name: str) -> tuple[str, dict[str, bytes]]:
    """The page of a notebook in Markdown, and its figures by their names."""
    exporter = MarkdownExporter(
        raw_template=TEMPLATE, filters={"description": description, "code": code}
    )
    text, resources = exporter.from_notebook_node(
        notebook, {"unique_key": name, "output_files_dir": "figures"}
    )
    figures = {}
    for path, png in (resources["outputs"] or {}).items():
        image, smaller = Image.open(io.BytesIO(png)), io.BytesIO()
        image.convert("RGB").save(smaller, "webp", lossless=True, method=6)
        where = path.replace(".png", ".webp")
        figures[where] = smaller.getvalue()
        width = round(image.width * 96 / DPI)  # letters are then as large in all figures
        text = text.replace(f"({path})", f'({where}){{ width="{width}" loading="lazy" }}')
    title, rest = text.lstrip().split("\n", 1)
    link = f"[Download this page as a notebook]({name}.ipynb)"
    return f"{title}\n\n{link}\n{rest}", figures
