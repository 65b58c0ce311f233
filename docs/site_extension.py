"""What the site adds to Sphinx: pages as notebooks, links to names, formulas."""

import re
from typing import Any

import nbformat
from docutils import nodes
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from sphinx.addnodes import download_reference, pending_xref
from sphinx.application import Sphinx

_CODE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PRINTED = re.compile(
    r"(^```python\n(?:(?!^```).)*^```\n)\n```text\n.*?^```$", re.MULTILINE | re.DOTALL
)
_FILE = re.compile(r"^```\w+\n(# (\w+\.(?:py|yaml))\n.*?)^```$", re.MULTILINE | re.DOTALL)
_LITERAL = re.compile(r"(``.*?``|\$\$.*?\$\$|\$[^$\n]+\$)", re.DOTALL)


def read_page(text: str) -> nbformat.NotebookNode:
    """Return a page as a notebook, its blocks of Python as the cells that run.

    What they print replaces the text below them. A hidden first cell writes the blocks whose first
    line names a file.
    """
    parts = _CODE.split(_PRINTED.sub(r"\1", text))
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


def lead_to_names(app: Sphinx, doctree: nodes.document) -> None:
    """Lead a link from a name to its source file to the page of the name."""
    for node in list(doctree.findall(download_reference)):
        if "/fusion_gym/" in node["reftarget"] and ".py" not in (name := node.astext()):
            target = {"refdomain": "py", "reftype": "obj", "reftarget": name}
            node.replace_self(pending_xref("", *node.children, **target, refspecific=True))


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
    """Connect the changes of pages and docstrings."""
    app.connect("doctree-read", lead_to_names, priority=400)  # before files to download are copied
    app.connect("autodoc-process-docstring", write_formulas)
    app.extensions["sphinx-mathjax-offline"].parallel_read_safe = True  # it names a file alone
    return {"parallel_read_safe": True, "parallel_write_safe": True}
