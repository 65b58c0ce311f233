"""Checks a built site: links, anchors, pictures, captions; with Chromium also how wide pages are.

python -m website.check site
"""

import posixpath
import re
import shutil
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from website.narrow import WIDTH, too_wide

_ELSEWHERE = ("http", "https", "mailto", "data")


class _Page(HTMLParser):
    """What a page links, shows and can be linked at."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.bare: list[str] = []  # pictures without a text, or outside figures
        self._figures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        result = {name: value or "" for name, value in attrs}
        self.anchors |= {result[name] for name in ("id", "name") if name in result}
        if tag in ("a", "link") and "href" in result:
            self.links.append(result["href"])
        if tag in ("img", "script") and "src" in result:
            self.links.append(result["src"])
        self._figures += tag == "figure"
        if tag == "img" and not (result.get("alt") and self._figures):
            self.bare.append(result.get("src", "")[:80])

    def handle_endtag(self, tag: str) -> None:
        self._figures -= tag == "figure"


def problems(site: Path) -> list[str]:
    """Links to nothing, anchors that do not exist, and pictures without a caption."""
    pages = {str(path.relative_to(site)): _read(path) for path in sorted(site.rglob("*.html"))}
    result = []
    for place, page in pages.items():
        if place == "404.html":
            continue
        result += [f"{place}: picture without a caption: {src}" for src in page.bare]
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme in _ELSEWHERE:
                continue
            joined = posixpath.join(posixpath.dirname(place), unquote(parts.path))
            target = posixpath.normpath(joined) if parts.path else place
            if target.endswith("/") or target in (".", ""):
                target = posixpath.join(target, "index.html")
            if not (site / target).exists():
                result.append(f"{place}: link to nothing: {link}")
            elif parts.fragment and target in pages:
                required = unquote(parts.fragment)
                if required not in pages[target].anchors and not required.startswith("__"):
                    result.append(f"{place}: no such place on the page: {link}")
    return result


def _read(path: Path) -> _Page:
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def fetched(site: Path) -> list[str]:
    """Scripts, styles and pictures that a reader's browser would fetch from elsewhere."""
    pattern = re.compile(r'<(?:script|img|link)[^>]+(?:src|href)="(https?://[^"]+)"')
    return sorted(
        {
            f"{path.relative_to(site)}: {url}"
            for path in site.rglob("*.html")
            for url in pattern.findall(path.read_text(encoding="utf-8"))
        }
    )


def main() -> None:
    """Print what is wrong and end with 1, or say what was checked."""
    site = Path(sys.argv[1] if sys.argv[1:] else "site")
    result = problems(site) + [f"fetched from elsewhere: {line}" for line in fetched(site)]
    count = len(list(site.rglob("*.html")))
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        print("no Chromium: the width of pages is not checked")
    else:
        result += [f"wider than {WIDTH} px: {line}" for line in too_wide(site, browser)]
    if result:
        print("\n".join(result))
        sys.exit(1)
    print(f"{count} pages: links, anchors, pictures" + (", widths" if browser else ""))


if __name__ == "__main__":
    main()
