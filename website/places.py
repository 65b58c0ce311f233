"""Which file of the repository is which page of the site, and where a link leads from there."""

import posixpath
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
REPOSITORY = "https://github.com/fusion-gym/fusion-gym"
# Texts outside docs/ that the site has as pages. The README's place is taken by the start page.
PAGES = {
    "results/README.md": "results/report.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
_SOURCES = {page: source for source, page in PAGES.items()}
_LINK = re.compile(r"(\]\()([^)\s#]*)(#[^)\s]*)?(\))")
_CODE = re.compile(r"(^```.*?^```)", re.DOTALL | re.MULTILINE)


@cache
def pages_of() -> dict[str, str]:
    """The page of each environment by its id, as the README's table has them, without ".md"."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return dict(re.findall(r"\[`(fusion_gym/[\w-]+)`\]\(docs/(\w+)\.md\)", text))


def source_of(page: str) -> str:
    """The file of the repository, from its root, of which a page is made."""
    return _SOURCES.get(page, f"docs/{page}")


def pictures() -> dict[str, Path]:
    """Figures outside docs/ by their place on the site, which keeps that in the repository."""
    result = sorted((ROOT / "results").rglob("*.png"))
    return {str(path.relative_to(ROOT)): path for path in result if "quick" not in path.parts}


def with_links(text: str, source: str, page: str) -> str:
    """The text of ``source`` with its relative links changed to what they are on ``page``.

    What the site does not have is linked in the repository. A link to nothing is left as it is,
    and the site's builder then tells of it. Blocks of code are left alone.
    """

    def changed(match: re.Match[str]) -> str:
        before, target, anchor, after = match.groups()
        if not target or re.match(r"\w+:", target):
            return match[0]
        result = _place(posixpath.normpath(posixpath.join(posixpath.dirname(source), target)), page)
        return match[0] if result is None else f"{before}{result}{anchor or ''}{after}"

    parts = _CODE.split(text)
    return "".join(
        part if index % 2 else _LINK.sub(changed, part) for index, part in enumerate(parts)
    )


def _place(path: str, page: str) -> str | None:
    """The link from a page to a file of the repository, by its path from the root."""
    if path in PAGES:
        target = PAGES[path]
    elif path == "README.md":
        target = "index.md"
    elif path.startswith("docs/"):
        target = path.removeprefix("docs/")
    elif path in pictures():
        target = path
    elif (ROOT / path).is_file():
        return f"{REPOSITORY}/blob/main/{path}"
    elif (ROOT / path).is_dir():
        return f"{REPOSITORY}/tree/main/{path}"
    else:
        return None
    return posixpath.relpath(target, posixpath.dirname(page) or ".")
