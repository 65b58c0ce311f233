"""Count the words of the pages' prose, without code, tables and formulas (``make lines``)."""

import re
from pathlib import Path

FOLDERS = "docs", "results"
OTHERS = re.compile(
    r"(?ms)<!-- table: .*?<!-- end -->|```.*?^ *```|\$\$.*?\$\$"
    r"|<!--.*?-->|</?\w[^>\n]*>|^ *(?:\||#|>>>|\.\.\.)[^\n]*$"
)
LITERAL = re.compile(r"(?s)`.*?`|\$.*?\$")


def words(text: str) -> int:
    """Return the number of words of Markdown; a literal or a formula is one."""
    prose = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", OTHERS.sub("\n\n", text), flags=re.DOTALL)
    return len(re.findall(r"\S*\w\S*", LITERAL.sub("X", prose)))


def main() -> None:
    """Print the number of each folder."""
    for folder in FOLDERS:
        count = sum(words(page.read_text(encoding="utf-8")) for page in Path(folder).rglob("*.md"))
        print(f"{'words in ' + folder:<18}{count:>6,}")


if __name__ == "__main__":
    main()
