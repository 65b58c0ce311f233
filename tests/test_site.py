"""What the site is made of, as far as that needs no builder: `make docs` checks the rest."""

import re
import shutil
from pathlib import Path

import pytest

from fusion_gym.envs.registration import ENVIRONMENTS
from website import check, environment_pages, part_pages, parts, places
from website.narrow import too_wide
from website.navigation import navigation


@pytest.mark.parametrize("folder", parts.KIND_NAMES)
def test_every_page_has_equation_assumption_and_source(folder: str) -> None:
    pages = part_pages.pages(folder)
    overview = pages.pop(f"{folder}/index.md")
    assert len(pages) > 7
    for place, text in pages.items():
        assert f"({Path(place).name})" in overview
        for head in ("Equation", "What it assumes", "Source"):
            body = re.search(rf"^## {head}\n\n(.+?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
            assert body is not None, f"{place}: {head}"
            assert len(body[1].strip()) > 5


def test_environment_pages_get_their_tables() -> None:
    assert places.pages_of().keys() == ENVIRONMENTS.keys()
    text = environment_pages.with_tables("# A page\n\nText.\n\n## One\n\nMore.\n", "biased")
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    assert heads[:3] == ["A page", "One", "From the code"]
    for name in ("BiasedOscillator-v0", "BiasedTracking-v0"):
        assert {f"{head} of {name}" for head in environment_pages.SECTIONS} <= set(heads)
        assert f"`fusion_gym/{name}`" in text.partition("## One")[0]


def test_links_lead_to_what_there_is() -> None:
    text = (
        "[a](step.md) [b](../results/README.md#overview) [c](../fusion_gym/linalg.py) "
        "[d](../nowhere.md) [e](https://example.org) ![f](../results/overview.png) "
        "[g](../results/learning)"
    )
    changed = places.with_links(text, "docs/use.md", "use.md")
    assert changed == (
        "[a](step.md) [b](results/report.md#overview) "
        f"[c]({places.REPOSITORY}/blob/main/fusion_gym/linalg.py) [d](../nowhere.md) "
        "[e](https://example.org) ![f](results/overview.png) "
        f"[g]({places.REPOSITORY}/tree/main/results/learning)"
    )
    assert places.with_links("[a](biased.md)", "docs/use.md", "x/y.md") == "[a](../biased.md)"


def test_the_navigation_has_every_page_once() -> None:
    def pages(tree: object) -> list[str]:
        if isinstance(tree, str):
            return [tree]
        parts_ = tree.values() if isinstance(tree, dict) else tree
        return [page for part in parts_ for page in pages(part)]  # type: ignore[union-attr]

    result = pages(navigation())
    assert len(result) == len(set(result))
    written = {str(path.relative_to(places.DOCS)) for path in places.DOCS.rglob("*.md")}
    assert written <= set(result)


def test_what_is_wrong_with_a_site_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<h1 id="top">A</h1><a href="b.html#there">b</a><a href="b.html#gone">b</a>'
        '<a href="c.html">c</a><figure><img src="b.html" alt="what to see"></figure>'
        '<img src="b.html" alt="no figure"><script src="https://example.org/x.js"></script>'
    )
    (tmp_path / "b.html").write_text('<p id="there">B</p><a href="a.html#top">a</a>')
    assert check.problems(tmp_path) == [
        "a.html: picture without a caption: b.html",
        "a.html: no such place on the page: b.html#gone",
        "a.html: link to nothing: c.html",
    ]
    assert check.fetched(tmp_path) == ["a.html: https://example.org/x.js"]


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Chromium")
def test_a_page_that_scrolls_sideways_is_found(tmp_path: Path) -> None:
    wide = '<div style="width: 600px">wide</div>'
    (tmp_path / "a.html").write_text(f"<!doctype html>{wide}")
    (tmp_path / "b.html").write_text(f'<!doctype html><div style="overflow: auto">{wide}</div>')
    result = too_wide(tmp_path, str(shutil.which("chromium")))
    assert [line.partition(" ")[0] for line in result] == ["a.html"]
