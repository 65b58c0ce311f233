"""What the site adds to Sphinx: pages as notebooks, tables of declarations, formulas."""

import html
import re
from typing import Any

import nbformat
from docutils import nodes
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import fusion_gym
from fusion_gym.docstrings import table
from fusion_gym.envs.pages import TABLES
from fusion_gym.envs.registration import options_of
from fusion_gym.envs.views import make_view
from fusion_gym.importing import import_named

_CODE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r"^```\w+\n(# (\w+\.(?:py|yaml))\n.*?)^```$", re.MULTILINE | re.DOTALL)
_LITERAL = re.compile(r"(``.*?``|\$\$.*?\$\$|\$[^$\n]+\$)", re.DOTALL)


def read_page(text: str) -> nbformat.NotebookNode:
    """Return a page as a notebook, its blocks of Python as the cells that run.

    A hidden first cell writes the blocks whose first line names a file.
    """
    parts = _CODE.split(text)
    cells = [
        new_code_cell(part.strip(), id=f"cell{place}")
        if place % 2
        else new_markdown_cell(part, id=f"cell{place}")
        for place, part in enumerate(parts)
        if part.strip()
    ]
    code = f"import pathlib\nfor text, name in {_FILE.findall(text)!r}:\n    "
    code += "pathlib.Path(name).write_text(text)\n"
    code += "get_ipython().ast_node_interactivity = 'none'"  # what a script prints, and figures
    if len(parts) > 1:
        cells.insert(0, new_code_cell(code, id="first", metadata={"tags": ["remove-cell"]}))
    metadata: dict[str, Any] = {"kernelspec": {"name": "python3", "display_name": "Python"}}
    metadata["language_info"] = {"name": "python", "pygments_lexer": "python"}
    if len(parts) == 1:
        metadata["mystnb"] = {"execution_mode": "off"}
    return new_notebook(cells=cells, metadata=metadata)


class DeclarationTable(SphinxDirective):
    """A table of what the code declares; its name is a kind of ``fusion_gym.envs.pages``."""

    required_arguments, final_argument_whitespace = 1, True

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        make = import_named("table", TABLES[self.name.removesuffix("-table")])
        return self.parse_text_to_nodes(make(" ".join(self.arguments[0].split())))


class EnvironmentFacts(SphinxDirective):
    """A table of what a registered environment is."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse the table."""
        env_id = self.arguments[0]
        task = fusion_gym.make_task(env_id)
        view, kind = make_view(task), options_of(env_id)
        filters = (f"`{name or owner.__name__}`" for name, owner in kind.filters.items())
        rows = [
            ("id", f"`{env_id}`"),
            ("sensors", str(task.sensors)),
            ("states", ", ".join(f"`{name}`" for name in task.system.state_names)),
            ("observation", f"{len(view.names)} float32 numbers"),
            ("action", f"`{view.actions}`"),
            ("steps of an episode", str(task.horizon)),
            ("filters", ", ".join(filters) or "–"),
        ]
        if kind.structure is not None:
            rows.append(("fusion", ", ".join(f"`{name}`" for name in kind.structure.offered)))
        return self.parse_text_to_nodes(table(("", env_id.split("/")[1]), rows))


def fold(app: Sphinx, doctree: nodes.document, name: str) -> None:
    """Fold long tables and blocks of code, and the reproduced figures below their headings."""
    papers = name.startswith("docs/reproduction/")
    for node in list(doctree.findall(nodes.table)):
        rows = list(node.findall(nodes.row))
        if len(rows) > (6 if papers else 13):
            head = ", ".join(entry.astext() for entry in rows[0].children)
            node.parent.replace(node, _folded(f"{len(rows) - 1} rows: {head}", [node]))
    for block in list(doctree.findall(nodes.literal_block)):
        lines = block.astext().splitlines()
        if len(lines) > 80:
            block.parent.replace(block, _folded(f"{len(lines)} lines", [block]))
    if papers:
        for node in doctree.findall(nodes.section):
            if re.match("Figure|Table", node[0].astext()):
                node[1:] = _folded("the picture", node[1:])


def _folded(summary: str, content: list[nodes.Node]) -> list[nodes.Node]:
    opening = f"<details><summary>{html.escape(summary)}</summary>"
    ends = (nodes.raw("", text, format="html") for text in (opening, "</details>"))
    return [next(ends), *content, next(ends)]


def write_formulas(
    app: Sphinx, what: str, name: str, owner: Any, options: Any, lines: list[str]
) -> None:
    """Turn the formulas of a docstring into those of reStructuredText, and escape its bars."""
    parts = _LITERAL.split("\n".join(lines))
    for place, part in enumerate(parts):
        if part.startswith("$$"):
            formula = part[2:-2].replace("\n", "\n    ").rstrip()
            parts[place] = f".. math::\n{formula}"
        elif part.startswith("$"):
            parts[place] = f":math:`{part[1:-1]}`"
        elif not part.startswith("``"):
            parts[place] = part.replace("|", "\\|")
    lines[:] = "".join(parts).split("\n")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives and the reader of docstrings."""
    for kind in TABLES:
        app.add_directive(f"{kind}-table", DeclarationTable)
    app.add_directive("environment-facts", EnvironmentFacts)
    app.connect("doctree-resolved", fold)
    app.connect("autodoc-process-docstring", write_formulas)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
