"""Docstrings as declarations: a summary, and sections with labels such as ``Source:``.

A label stands at the beginning of a paragraph; indented paragraphs below belong to it.
"""

import inspect
import re
import textwrap
from collections.abc import Iterable
from typing import Any, NamedTuple

_LABEL = re.compile(r"(Args|Returns|Raises|Equation|Assumes|Sources?|Example):[ \n]")
_ARGUMENT = re.compile(r"^(\w+): (.*(?:\n .*)*)", re.MULTILINE)


class Docstring(NamedTuple):
    """The text without labels, and the text of each label."""

    text: str
    labelled: dict[str, str]

    @property
    def summary(self) -> str:
        """First sentence, in one line."""
        return re.split(r"(?<=[.])\s", " ".join(self.text.split()), maxsplit=1)[0]

    @property
    def arguments(self) -> dict[str, str]:
        """Meaning of each argument in the section ``Args``."""
        result = _ARGUMENT.findall(self.labelled.get("Args", ""))
        return {name: " ".join(meaning.split()) for name, meaning in result}


def read(owner: Any) -> Docstring:
    """Return the parsed docstring of a class or function, with ``Sources`` as ``Source``."""
    text: list[str] = []
    labelled: dict[str, list[str]] = {}
    section = text
    for paragraph in (inspect.getdoc(owner) or "").split("\n\n"):
        if label := _LABEL.match(paragraph):
            name = "Source" if label[1] == "Sources" else label[1]
            section = labelled.setdefault(name, [])
            paragraph = paragraph[label.end() :]
        elif not paragraph.startswith(" "):
            section = text
        section.append(paragraph)
    parts = {name: textwrap.dedent("\n\n".join(value)) for name, value in labelled.items()}
    return Docstring("\n\n".join(text), parts)


def plain_marks(text: str) -> str:
    """Return a docstring's text with Markdown's code marks."""
    return re.sub(r":\w+:`~?|``", "`", text)


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Return a Markdown table with aligned source columns."""
    lines = [head, *(tuple(cell.replace("|", "\\|") for cell in row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head) - 1)]
    padded = ["| " + " | ".join(map(str.ljust, line, (*widths, 0))) + " |" for line in lines]
    return "\n".join((padded[0], "|---" * len(head) + "|", *padded[1:]))
