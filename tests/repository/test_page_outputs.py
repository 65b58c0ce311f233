"""A block of text directly below Python on a page is what the Python prints.

A training ends in other weights on another machine, so its results are not compared.
"""

import contextlib
import io
import re
from pathlib import Path

import pytest
from page_blocks import LANGUAGES
from paths import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SLOW = {"README", "start", "newcomer"}  # they train agents
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PRINTED = re.compile(r"^```python\n(?:(?!^```).)*^```\n\n```text$", re.DOTALL | re.MULTILINE)


def outputs(path: Path) -> list[tuple[str, str]]:
    """Return what each block of Python should print, and what it prints."""
    text, names, result = path.read_text(), {"__name__": "__main__"}, []
    last = [match.end() for match in PRINTED.finditer(text)][-1]
    blocks = [match for match in BLOCK.finditer(text) if match.start() < last]
    for place, block in enumerate(blocks):
        if (name := re.match(r"# (\w+\.(?:py|yaml))\n", block[2])) and block[1] in LANGUAGES:
            Path(name[1]).write_text(block[2])
        if block[1] == "python":
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(block[2], f"{path.name} {place}", "exec"), names)
            below = blocks[place + 1] if place + 1 < len(blocks) else block
            shown = below[1] == "text" and text[block.end() : below.start()] == "\n\n"
            if shown and ".learn(" not in block[2]:
                result.append((below[2], printed.getvalue()))
    return result


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=pytest.mark.slow if path.stem in SLOW else ())
        for path in PAGES
        if PRINTED.search(path.read_text())
    ],
    ids=lambda path: path.stem,
)
def test_python_prints_the_text_below_it(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for shown, printed in outputs(path):
        assert printed.rstrip() == shown.rstrip()
