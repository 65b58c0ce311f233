"""What the site is made of, as far as that needs no builder: `make docs` checks the rest."""

import re
from pathlib import Path

import pytest

from fusion_gym.envs.registration import ENVIRONMENTS
from website import environment_pages, parts, places, reference


@pytest.mark.parametrize("kind", parts.KIND_NAMES)
def test_every_part_has_a_page_with_its_declaration(kind: str) -> None:
    pages = parts.pages(kind)
    overview = pages.pop(f"{kind}/index.md")
    assert len(pages) > 7
    for place, text in pages.items():
        assert f"({Path(place).name})" in overview
        assert re.search(r"^::: fusion_gym\.[\w.]+$", text, re.MULTILINE)


def test_environment_pages_get_their_tables() -> None:
    assert places.pages_of().keys() == ENVIRONMENTS.keys()
    text = environment_pages.with_tables("# A page\n\nText.\n\n## One\n\nMore.\n", "biased")
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    assert heads[:3] == ["A page", "One", "From the code"]
    for name in ("BiasedOscillator-v1", "BiasedTracking-v1"):
        assert {f"{head} of {name}" for head in environment_pages.SECTIONS} <= set(heads)
        assert f"`fusion_gym/{name}`" in text.partition("## One")[0]


def test_links_lead_to_what_there_is() -> None:
    text = (
        "[a](step.md) [b](../results/README.md#overview) [c](../fusion_gym/linalg.py) "
        "[d](../nowhere.md) [e](https://example.org) ![f](../results/tobit_oscillator.png) "
        "[g](../tests/laws)"
    )
    changed = places.with_links(text, "docs/use.md", "use.md")
    assert changed == (
        "[a](step.md) [b](results/report.md#overview) "
        f"[c]({places.REPOSITORY}/blob/main/fusion_gym/linalg.py) [d](../nowhere.md) "
        "[e](https://example.org) ![f](results/tobit_oscillator.png) "
        f"[g]({places.REPOSITORY}/tree/main/tests/laws)"
    )
    assert places.with_links("[a](biased.md)", "docs/use.md", "x/y.md") == "[a](../biased.md)"


def test_the_navigation_has_every_page_once() -> None:
    text = (places.ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2].partition("\nhooks:")[0]
    pages = re.findall(r"[\w/]+\.md", text)
    assert len(pages) == len(set(pages))
    written = {str(path.relative_to(places.DOCS)) for path in places.DOCS.rglob("*.md")}
    assert set(pages) == written | set(places.PAGES.values())


def test_the_navigation_of_the_reference_has_every_module() -> None:
    first, *groups = reference.navigation()
    listed = [page for group in groups for pages in group.values() for page in pages]
    assert {first, *(place for page in listed for place in page.values())} == set(reference.pages())
