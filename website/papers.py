"""The papers of which docstrings speak by a word, and where they are cited in full."""

import re
import sys

from fusion_gym.docstrings import read
from fusion_gym.envs.registration import options_of
from website.places import DOCS, pages_of


def paper_of(env_id: str) -> str:
    """The word by which the module of the environment's options names its paper, or nothing."""
    module = read(sys.modules[options_of(env_id).__module__]).labelled.get("Source", "")
    return re.split(r"\W", module)[0]


def citations(text: str) -> list[str]:
    """What the papers are of which a text speaks by their words, with links to what is made."""
    result, visited = [], set()
    for env_id, page in pages_of().items():
        word = paper_of(env_id)
        if word and page not in visited and re.search(rf"\b{word}\b(?![./])", text):
            visited.add(page)
            told = (DOCS / f"{page}.md").read_text(encoding="utf-8")
            source = re.search(r"^Source: (.*?)\n\n", told, re.MULTILINE | re.DOTALL)
            assert source is not None, page
            cited = " ".join(source[1].split()).replace(
                " Numbers in brackets are that paper's equations.", ""
            )
            links = f"[our reading of it](../{page}.md)"
            if (DOCS / "reproduction" / f"{word}.md").exists():
                links += f", [its figures and claims, reproduced](../reproduction/{word}.md)"
            result.append(f"*{word}* is {cited} See {links}.")
    return result
