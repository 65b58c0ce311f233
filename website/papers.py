"""The papers of which docstrings speak by a word, and where they are cited in full."""

from __future__ import annotations

import re

from website.places import DOCS

# The page of the environment that cites the paper of which docstrings speak by this word.
PAPERS = {
    "tobit_token_bucket": "tobit_oscillator",
    "adaptive_innovation": "correlated_tracking",
    "markov_jump": "markov_jump",
    "unknown_input": "unknown_input",
    "round_robin_tobit": "biased",
}


def citations(text: str) -> list[str]:
    """What the papers are of which a text speaks by their words, with links to what is made."""
    found = []
    for word, page in PAPERS.items():
        if re.search(rf"\b{word}\b(?![./])", text):
            source = re.search(r"^Source: (.*?)\n\n", _doc(page), re.MULTILINE | re.DOTALL)
            assert source is not None, page
            cited = " ".join(source[1].split()).replace(
                " Numbers in brackets are that paper's equations.", ""
            )
            links = f"[our reading of it](../{page}.md)"
            if (DOCS / "reproduction" / f"{word}.md").exists():
                links += f", [its figures and claims made anew](../reproduction/{word}.md)"
            found.append(f"*{word}* is {cited} See {links}.")
    return found


def _doc(page: str) -> str:
    return (DOCS / f"{page}.md").read_text(encoding="utf-8")
