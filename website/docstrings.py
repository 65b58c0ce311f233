"""Docstrings as Markdown: their code marks, cross-references and labelled paragraphs."""

from __future__ import annotations

import inspect
import re
from typing import Any, NamedTuple

_ROLE = re.compile(r":\w+:`(?P<short>~?)(?P<name>[\w.]+)`")
_SECTIONS = re.compile(r"^(Args|Returns|Raises|Yields):$")
_LABEL = re.compile(r"^(Assumes|Sources?): (.*)$", re.DOTALL)


class Told(NamedTuple):
    """A docstring in parts: its text, what it assumes, and its source."""

    text: str
    assumes: str
    source: str


def told(owner: Any) -> Told:
    """The docstring of a class or function without its sections of arguments.

    Raises:
        ValueError: a docstring that does not say what it assumes or where it comes from.
    """
    paragraphs = [part.strip("\n") for part in inspect.getdoc(owner).split("\n\n")]  # type: ignore[union-attr]
    text: list[str] = []
    labelled: dict[str, str] = {}
    skipping = False
    for paragraph in paragraphs:
        if _SECTIONS.match(paragraph.split("\n")[0]):
            skipping = True
        elif found := _LABEL.match(paragraph):
            labelled[found[1].rstrip("s") if found[1] != "Assumes" else "Assumes"] = found[2]
        elif not (skipping and paragraph.startswith(" ")):
            skipping = False
            text.append(paragraph)
    missing = {"Assumes", "Source"} - labelled.keys()
    if missing:
        raise ValueError(f"{owner.__qualname__}: no {' and no '.join(sorted(missing))} in its text")
    return Told(
        markdown("\n\n".join(text)), markdown(labelled["Assumes"]), markdown(labelled["Source"])
    )


def markdown(text: str) -> str:
    """Code marks and asterisks as Markdown has them; references to objects by their last name."""
    text = re.sub(r"(?<![*\\])\*(?!\*)", r"\\*", text)

    def name(match: re.Match[str]) -> str:
        full = match["name"]
        if not full.startswith("fusion_gym.") or full.startswith("fusion_gym.agents"):
            return f"`{full}`"
        return f"[`{full.rpartition('.')[2]}`][{full}]"

    return _ROLE.sub(name, text).replace("``", "`")
