"""The reference: a page a public module of the library, made of its docstrings."""

import ast
from pathlib import Path

from website.docstrings import markdown
from website.places import ROOT

_PACKAGE = ROOT / "fusion_gym"
_INTRO = """\
# Reference

Every public module of the library, from its docstrings. Shapes have the batch axis N last. What
most people need is imported by `import fusion_gym` alone:

::: fusion_gym
    options:
      heading_level: 2
      show_root_heading: false

## Modules

"""


def modules() -> dict[str, str]:
    """Public modules with the first line of their docstrings, by their dotted names."""
    result = {}
    for path in sorted(_PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if any(part.startswith("_") and part != "__init__" for part in parts):
            continue
        name = ".".join(part for part in parts if part != "__init__")
        if name != "fusion_gym":
            result[name] = _first_line(path)
    return result


def place(module: str) -> str:
    """Where the page of a module stands."""
    return f"api/{module}.md"


def pages() -> dict[str, str]:
    """All pages of the reference by their places."""
    every = modules()
    rows = [f"| [`{name}`]({name}.md) | {line} |" for name, line in every.items()]
    result = {"api/index.md": _INTRO + "\n".join(["| | |", "|---|---|", *rows]) + "\n"}
    for name in every:
        result[place(name)] = f"# `{name}` {{ #{name} }}\n\n::: {name}\n"
    return result


def _first_line(path: Path) -> str:
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return markdown(text.partition("\n")[0]).replace("|", "\\|")
