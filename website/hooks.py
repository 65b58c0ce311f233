"""What the site's builder calls: pages that are made, links, equations, figures."""

import os
import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))
os.environ.setdefault("MPLBACKEND", "Agg")

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from website import environment_pages, markup, parts, places, reference

# In the search: a part's own page goes before those that only name it, and long tables come last.
_RANKED = "---\nsearch:\n  boost: {:g}\n---\n\n"
_FIRST, _LAST = 4.0, 0.2
_README = re.compile(r"^<!-- README: (.+?) -->$", re.MULTILINE)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The table of contents of mkdocs.yml, with the pages that are made."""
    kinds = [{title: list(parts.pages(kind))} for kind, title in parts.KIND_NAMES.items()]
    made = {"Parts": kinds, "Reference": reference.navigation()}
    config.nav = [
        {title: made.get(title, page) for title, page in item.items()} for item in config.nav
    ]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what is made: pages of parts and modules, texts and figures from outside docs/."""

    def add(place: str, content: str | bytes) -> None:
        files.append(File.generated(config, place, content=content))

    for source, page in places.PAGES.items():
        add(page, _RANKED.format(_LAST) + (places.ROOT / source).read_text(encoding="utf-8"))
    for place, path in places.pictures().items():
        files.append(File.generated(config, place, abs_src_path=str(path)))
    add("site.css", (Path(__file__).parent / "site.css").read_text(encoding="utf-8"))
    for kind in parts.KIND_NAMES:
        for place, text in parts.pages(kind).items():
            add(place, _RANKED.format(_FIRST) + text)
    for place, text in reference.pages().items():
        add(place, text)
    return files


def on_page_markdown(markdown: str, page: Page, **kwargs: Any) -> str:
    """Parts of the README, tables of environments, links, and blank lines before lists."""
    place = page.file.src_uri
    name = place.removesuffix(".md")
    if environment_pages.of_page(name):
        markdown = environment_pages.with_tables(markdown, name)
    markdown = places.with_links(markdown, places.source_of(place), place)
    return markup.separated(_README.sub(lambda value: _of_readme(value[1], place), markdown))


def on_page_content(html: str, **kwargs: Any) -> str:
    """Equations as pictures, pictures as figures."""
    return markup.captioned(markup.drawn(html))


def _of_readme(heading: str, page: str) -> str:
    """A section of the README by its heading, without that, with links as on the page."""
    text = (places.ROOT / "README.md").read_text(encoding="utf-8")
    parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    return places.with_links(sections[heading].strip(), "README.md", page)
