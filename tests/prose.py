"""Count the words and the sentences of pages and public docstrings (``make docs`` runs it)."""

import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fusion_gym.importing import import_named

ROOT = Path(__file__).parent.parent
LIMITS = {"docs": 20_000, "results": 2_000}
NO_PROSE = re.compile(
    r"```.*?^ *```|\$\$.*?\$\$|<!--.*?-->|<[^>]+>|!\[.*?\]\(.*?\)|^ *(?:\||#|>>>|\.\.\.|\[\d+\]:)[^\n]*$"
    r"|^(?:Args|Raises|Returns|Yields|Source|Equation|Example|Examples|Note):$",
    re.DOTALL | re.MULTILINE,
)
LITERAL = re.compile(r"``.*?``|`.*?`|\$.*?\$|:\w+:`.*?`", re.DOTALL)


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of Markdown or of a docstring; items of a list are paragraphs."""
    text = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", NO_PROSE.sub("\n\n", text), flags=re.DOTALL)
    for paragraph in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.)\s", LITERAL.sub("X", text)):
        for sentence in re.split(r"(?<=[.!?:;])[*)”\"]*\s+", " ".join(paragraph.split())):
            if re.search(r"\w", sentence):
                yield sentence


def docstrings() -> Iterator[str]:
    """Yield the docstrings of what the reference lists, members included."""
    for page in ("reference", "rules", "filters"):
        listed = re.findall(r"^   (fusion_gym\S+)$", (ROOT / f"docs/{page}.md").read_text(), re.M)
        for name in listed:
            owner = import_named("name", name)
            yield inspect.getdoc(owner) or ""
