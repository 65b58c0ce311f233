"""The blocks of README and docs, and what each needs beside the wheel.

A block is Python, shell or YAML by its fence. An HTML comment before it names extras of the wheel,

    <!-- needs: agents, render -->

where it needs others than the commands do. Blocks of one ``session`` go on with each
other's names, as a reader of the page does; lines marked ``markdown-exec: hide`` are not printed.
A first line ``# plant.yaml`` names the file that a block is.
"""

import re
import shlex
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

LANGUAGES = {"python": "python", "py": "python", "bash": "shell", "sh": "shell", "yaml": "yaml"}
HIDDEN = "# markdown-exec: hide"
COMMAND = re.compile(r"^(fusion-gym|make|pip install|python -m (agents|benchmarks|fusion_gym))\b")
_FENCE = re.compile(r"^ *(```+)\s*(\w*)(.*)$")
_ALL = re.DOTALL | re.MULTILINE
_NEEDS = re.compile(r"^\s*<!-- needs: ([\w, -]+?) -->\s*$")


@dataclass(frozen=True)
class Block:
    """A block of a page, from a ``line`` on; ``named`` are extras that the page names."""

    page: Path
    line: int
    language: str | None
    text: str
    named: frozenset[str] = frozenset()
    session: str | None = None

    @property
    def place(self) -> str:
        """Where it is."""
        return f"{self.page}:{self.line}"

    @property
    def file(self) -> str | None:
        """The name of the file that it is."""
        result = re.match(r"# ([\w/]+\.(?:py|yaml))\n", self.text)
        return result[1] if result else None

    def commands(self) -> list[tuple[str, list[str]]]:
        """The lines of a shell block and their words: continued ones as one, comments none."""
        lines = self.text.replace("\\\n", " ").splitlines()
        read = [(line, shlex.split(line, comments=True)) for line in lines]
        return [(line, words) for line, words in read if words]

    @property
    def needs(self) -> frozenset[str]:
        """The extras of a shell block: those named, or that of the commands."""
        return self.named or frozenset({"agents"})


def blocks_of(page: Path, text: str) -> list[Block]:
    """The blocks of a page in their order; those of a session as one, where the last is."""
    result: list[Block] = []
    sessions: dict[str, Block] = {}
    for block in _fenced(page, text):
        if block.language is None:
            continue
        if block.session is not None:
            before = sessions.get(block.session)
            if before is not None:
                result.remove(before)
                named = before.named | block.named
                block = replace(block, line=before.line, text=before.text + block.text, named=named)
            sessions[block.session] = block
        result.append(block)
    return result


def stray_commands(page: Path, text: str) -> list[str]:
    """Commands outside of shell blocks, where nothing runs them."""
    lines = [
        (block.line + 1 + shift, line)
        for block in _fenced(page, text)
        if block.language is None
        for shift, line in enumerate(block.text.splitlines())
    ]
    outside = re.sub(r"^```.*?^```", lambda value: "\n" * value[0].count("\n"), text, flags=_ALL)
    lines += [
        (place, line)
        for place, line in enumerate(outside.splitlines(), 1)
        if line.startswith("    ")
    ]
    return [f"{page}:{place}: {line}" for place, line in lines if COMMAND.match(line.strip())]


def _fenced(page: Path, text: str) -> Iterator[Block]:
    lines = text.splitlines()
    place, named = 0, frozenset[str]()
    while place < len(lines):
        opening, comment = _FENCE.match(lines[place]), _NEEDS.match(lines[place])
        if comment:
            named = frozenset(re.split(r"[, ]+", comment[1].strip()))
        elif opening:
            fence, word, rest = opening.groups()
            closing = next(at for at in range(place + 1, len(lines)) if lines[at].strip() == fence)
            visible = [line for line in lines[place + 1 : closing] if HIDDEN not in line]
            code = textwrap.dedent("\n".join(visible)) + "\n"
            session = re.search(r'session="(\w+)"', rest)
            yield Block(
                page, place + 1, LANGUAGES.get(word), code, named, session[1] if session else None
            )
            place, named = closing, frozenset()
        elif lines[place].strip():
            named = frozenset()
        place += 1
