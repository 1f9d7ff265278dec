"""What the site takes from the package: its API, commands, effects, glossary, figures, KaTeX.

A hook of MkDocs. The public names are those of the rooms' `__init__.pyi`, each documented where it
is defined.
"""

import ast
import importlib
import re
from pathlib import Path
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

import snrmjax
from snrmjax.cli import app
from snrmjax.numerics.units import unit_in_print

SITE = Path(__file__).parent
PACKAGE = SITE.parents[1] / "snrmjax"
KATEX = SITE / "node_modules/katex/dist"
ROOMS = (
    *("measure", "identify", "simulate", "model", "diagnose", "doctor", "methods"),
    *("condense", "study", "pipelines", "io", "io.calculix", "plot"),
)
NO_MORE_THAN_ITS_DOCSTRING = (
    "{members: false, show_root_heading: false, show_root_toc_entry: false}"
)
# What all results share, and what all effects do: bases that no room exports.
BASES = {
    "identify": ["snrmjax.numerics.result.AbstractResult", "snrmjax.numerics.status.Status"],
    "model": ["snrmjax.model.effect_base.AbstractEffect"],
}


def public_names(module: str) -> dict[str, str]:
    """Where each public name of a module is defined, namespaces left out."""
    folder = PACKAGE.joinpath(*module.split(".")) if module else PACKAGE
    stub = folder / "__init__.pyi"
    path = stub if stub.is_file() else folder.with_suffix(".py")
    package = f"snrmjax.{module}" if module else "snrmjax"
    found: dict[str, str] = {}
    tree = ast.parse(path.read_text(encoding="utf-8"))
    public = next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    )
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or node.level == 0):
            source = f"{package}.{node.module}" if node.level else str(node.module)
            found |= {name.name: f"{source}.{name.name}" for name in node.names}
    names = {name: found[name] for name in public if name in found}
    missing = [n for n in public if n not in names and f"{module}.{n}".strip(".") not in ROOMS]
    if missing:
        raise PluginError(f"{path}: no page would have the public names {', '.join(missing)}.")
    return names


def api_page(room: str) -> str:
    """Every public name of a room, for mkdocstrings."""
    blocks = [
        f"# sj.{room}",
        "With `import snrmjax as sj`.",
        f"::: snrmjax.{room}\n    options: {NO_MORE_THAN_ITS_DOCSTRING}",
        *(f"::: {where}" for where in public_names(room).values()),
    ]
    if room in BASES:
        blocks += ["## What these have in common"]
        blocks += [f"::: {where}\n    options: {{heading_level: 3}}" for where in BASES[room]]
    return "\n\n".join(blocks) + "\n"


def first_sentence(text: str | None) -> str:
    """The first line of a docstring."""
    return cell((text or "").strip().partition("\n")[0])


def top_page() -> str:
    """The verbs of `sj`, each linked to its room or documented here, and the rooms."""
    elsewhere = {where for room in ROOMS for where in public_names(room).values()}
    verbs = ["| verb | what it does |", "|---|---|"]
    here = []
    for name, where in public_names("").items():
        said = first_sentence(getattr(snrmjax, name).__doc__)
        verbs.append(f"| [`sj.{name}`][{where}] | {said} |")
        if where not in elsewhere:
            here.append(f"::: {where}")
    rooms = ["| namespace | what it holds |", "|---|---|"]
    for room in ROOMS:
        said = first_sentence(importlib.import_module(f"snrmjax.{room}").__doc__)
        rooms.append(f"| [`sj.{room}`]({room}.md) | {said} |")
    blocks = [
        "# snrmjax",
        "With `import snrmjax as sj`. Every name has shapes, units and errors beside it; the words "
        "are in the [glossary](../glossary.md).",
        *("## The verbs to start with", "\n".join(verbs)),
        *("## The rest, by namespace", "\n".join(rooms)),
        *("## Only here", *here),
    ]
    return "\n\n".join(blocks) + "\n"


def cell(text: str) -> str:
    """Text for a cell of a table."""
    return re.sub(r"\s+", " ", text).replace("|", "\\|").strip()


def commands_page() -> str:
    """Every command with its options, as `--help-all` says them."""
    said = "`--help` says the main options of a command, `--help-all` the same as this page."
    blocks = ["# Commands", said]

    def add(command: Any, name: str) -> None:
        if hasattr(command, "commands"):
            for key, one in command.commands.items():
                add(one, f"{name} {key}")
            return
        rows = ["| option | what it is |", "|---|---|"]
        for option in command.params:
            if option.hidden or option.name in ("help", "help_all"):
                continue
            if option.param_type_name == "option":
                words = [f"`{word}`" for word in (*option.opts, *option.secondary_opts)]
                words.append("" if option.is_flag else cell(option.metavar or ""))
            else:
                words = [f"`{option.metavar or option.name.upper()}`"]
            if option.required:
                words.append("(required)")
            rows.append(f"| {' '.join(filter(None, words))} | {cell(option.help or '')} |")
        blocks.extend([f"## {name}", command.help or "", "\n".join(rows)])
        examples = command.epilog.replace("\n\n", "\n")
        blocks.append(f"```sh\n{examples}\n```")

    add(typer.main.get_command(app), "snrmjax")
    return "\n\n".join(blocks) + "\n"


def effects_page() -> str:
    """Every effect that files and diagnoses know."""
    blocks = [
        "# Effects",
        "The kinds that a model file may name under `[[effect]]`. Without `at` or `between` they "
        "act on the mode of interest and their parameters are modal; with them they act at points "
        "and their parameters are in N, m and kg "
        "([how to place one](../how-to/element.md)). A force c·|v|ⁿ or c·|x|ⁿ at one point, where "
        "the mode has the mass-normalised shape φ, has the modal coefficient c·φⁿ⁺¹: a spring k₃x³ "
        'is `cubic_stiffness` with k₃φ⁴, or `"1111" = k₃φ⁴/4` in `[potential]`, whose force is its '
        "derivative.",
    ]
    tables = snrmjax.model.EFFECTS, snrmjax.model.ELEMENTS, snrmjax.model.LAWS
    for kind, effect in (entry for table in tables for entry in table.items()):
        rows = ["| parameter | what it is | modal unit |", "|---|---|---|"]
        for name, of in effect.parameters().items():
            rows.append(
                f"| `{name}` | {cell(of.meaning)} | {cell(unit_in_print(of.unit) or '1')} |"
            )
        blocks += [f"## {kind}", effect.description, "\n".join(rows)]
    return "\n\n".join(blocks) + "\n"


def glossary() -> str:
    """The glossary of the package's docstring, its terms in bold."""
    text = (snrmjax.__doc__ or "").partition("Glossary\n")[2]
    return re.sub(r"^- ([^:]+):", r"- **\1**:", text.strip(), flags=re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, the figures and KaTeX."""
    if not KATEX.is_dir():
        raise PluginError("KaTeX is not installed: run `npm ci --prefix notebooks/site` once.")
    pages = {f"reference/{room}.md": api_page(room) for room in ROOMS}
    pages["reference/index.md"] = top_page()
    pages["reference/commands.md"] = commands_page()
    pages["reference/effects.md"] = effects_page()
    for path, content in pages.items():
        files.append(File.generated(config, path, content=content))
    scripts = [
        KATEX / "katex.min.js",
        KATEX / "katex.min.css",
        KATEX / "contrib/auto-render.min.js",
    ]
    assets = {f"assets/katex/{path.name}": path for path in scripts}
    assets |= {f"assets/katex/fonts/{p.name}": p for p in (KATEX / "fonts").glob("*.woff2")}
    assets |= {f"assets/figures/{p.name}": p for p in (SITE.parent / "figures").glob("*.png")}
    for path, source in assets.items():
        files.append(File.generated(config, path, abs_src_path=str(source)))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put the package's glossary where a page asks for it."""
    return markdown.replace("<!-- glossary of the package -->", glossary())
