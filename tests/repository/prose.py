"""Count the words and sentences of pages and public docstrings; ``make docs`` runs it."""

import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fusion_gym.importing import import_named

ROOT = Path(__file__).parents[2]
WORDS = {"docs": 22_500, "results": 2_000}
MEAN, LONGEST, LONGER = 17, 25, 5
BLOCKS = re.compile(
    r"(?ms)<!-- table: .*?<!-- end -->|```.*?^ *```|\$\$.*?\$\$"
    r"|<!--.*?-->|</?\w[^>\n]*>|^ *(?:\||#|>>>|\.\.\.)[^\n]*$"
)
LITERAL = re.compile(r"(?s):\w+:`.*?`|``.*?``|`.*?`|\$.*?\$")
PARAGRAPH = re.compile(r"\n\s*\n|\n\s*(?:[-*]|\d+\.)\s|\n\s+(?=\w+:\s)")


def sentences(text: str) -> Iterator[int]:
    """Yield the words of each sentence of Markdown or of a docstring."""
    prose = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", BLOCKS.sub("\n\n", text), flags=re.DOTALL)
    for paragraph in PARAGRAPH.split(prose):
        for sentence in re.split(r"(?<=[.!?])[*)”\"]*\s+", LITERAL.sub("X", paragraph)):
            yield from filter(None, [len(re.findall(r"\S*\w\S*", sentence))])


def docstrings() -> Iterator[str]:
    """Yield the docstrings of the objects of the reference, with their public members."""
    text = (ROOT / "docs/names.rst").read_text()
    for name in re.findall(r"^   (fusion_gym\.[\w.]+)$", text, re.MULTILINE):
        owner = import_named("name", ":".join(name.rsplit(".", 1)))
        members = vars(owner).items() if isinstance(owner, type) else ()
        for member in (owner, *(value for key, value in members if key[0] != "_")):
            yield inspect.getdoc(member) or ""


def main() -> str | None:
    """Print the counts, and return what is above its limit."""
    pages = {f: (ROOT / f).rglob("*.md") for f in WORDS}
    counts = {f: [n for page in pages[f] for n in sentences(page.read_text())] for f in WORDS}
    lengths = np.hstack([*counts.values(), [n for text in docstrings() for n in sentences(text)]])
    results = [(f"words in {f}", float(sum(counts[f])), WORDS[f]) for f in WORDS]
    results += [("mean words of a sentence", float(lengths.mean()), MEAN)]
    results += [("longer sentences, %", 100.0 * float(np.mean(lengths > LONGEST)), LONGER)]
    for name, value, limit in results:
        print(f"{name}: {value:,.4g} of at most {limit:,}")
    return ", ".join(name for name, value, limit in results if value > limit) or None


if __name__ == "__main__":
    sys.exit(main())
