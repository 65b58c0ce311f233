"""The blocks of docs/other_libraries.md and docs/recipes.md, run as a reader would run them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "docs" / name for name in ("other_libraries.md", "recipes.md")]
PAGE = "\n## ".join(path.read_text(encoding="utf-8") for path in PAGES)


def section(library: str) -> str:
    """What the page says under a heading."""
    return PAGE.split(f"\n## {library}\n")[1].split("\n## ")[0]


def run(library: str) -> dict[str, Any]:
    """Run a library's block as a script; returns its names."""
    (code,) = re.findall(r"^```py(?:thon)?\n(.*?)^```", section(library), re.DOTALL | re.MULTILINE)
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(code, f"docs, {library}", "exec"), names)
    return names


def command(library: str) -> list[str]:
    """The words of a library's command line."""
    (line,) = re.findall(r"^```\n(.*?)^```", section(library), re.DOTALL | re.MULTILINE)
    return shlex.split(line.replace("\\\n", " "))
