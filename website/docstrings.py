"""Docstrings as Markdown: their code marks and cross-references."""

import re

_ROLE = re.compile(r":\w+:`(?P<short>~?)(?P<name>[\w.]+)`")


def markdown(text: str) -> str:
    """Code marks and asterisks as Markdown has them; references to objects by their last name."""
    text = re.sub(r"(?<![*\\])\*(?!\*)", r"\\*", text)

    def name(match: re.Match[str]) -> str:
        full = match["name"]
        if not full.startswith("fusion_gym.") or full.startswith("fusion_gym.commands"):
            return f"`{full}`"
        return f"[`{full.rpartition('.')[2]}`][{full}]"

    return _ROLE.sub(name, text).replace("``", "`")
