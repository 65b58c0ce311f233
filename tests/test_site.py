"""What the site is made of, as far as that needs no builder: `make docs` checks the rest."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from fusion_gym.agents.output import palette
from fusion_gym.envs import drawing
from fusion_gym.envs.registration import ENVIRONMENTS
from website import check, environment_pages, part_pages, parts, places
from website.docstrings import markdown
from website.narrow import too_wide
from website.navigation import navigation

ROOT = Path(__file__).parent.parent
# What is told apart by colour in one figure; light and dark of a kind also differ by their marks.
FAMILIES = {
    "rules": palette.RULES.colour,
    "rules, memory": palette.RULES_MEMORY.colour,
    "agents": palette.AGENTS.colour,
    "agents, memory": palette.AGENTS_MEMORY.colour,
    "improved by simulation": palette.ROLLOUT.colour,
    "reference": palette.REFERENCE.colour,
    "bound": palette.BOUND.colour,
    "single rules": palette.GREY,
}
# Difference of two colours, ΔE of CIEDE2000, that a glance at a thin line sees: a just noticeable
# one is about 2 of large patches side by side.
APART = 10.0


@pytest.mark.parametrize("severity", [0.0, 1.0], ids=["all colours", "deuteranopia"])
def test_the_families_colours_stay_apart(severity: float) -> None:
    seen = {name: lab(simulated(colour, severity)) for name, colour in FAMILIES.items()}
    names = sorted(seen)
    close = {
        (one, other): round(float(difference(seen[one], seen[other])), 1)
        for place, one in enumerate(names)
        for other in names[place + 1 :]
        if difference(seen[one], seen[other]) < APART
    }
    assert not close


def test_red_and_green_would_be_seen_as_too_close() -> None:
    """The simulation sees what the palette avoids."""
    red, green = (lab(simulated(colour, 1.0)) for colour in ("#b00000", "#4a7a00"))
    assert difference(red, green) < APART < difference(lab(rgb("#b00000")), lab(rgb("#4a7a00")))


def test_films_use_the_same_colours() -> None:
    assert palette.VERMILLION == drawing._ESTIMATE
    assert palette.BLUE == drawing._GRANTED
    assert palette.GREEN == drawing._TOKENS


def test_the_difference_of_colours_is_the_published_one() -> None:
    """Pairs of Table 1 of G. Sharma, W. Wu and E. N. Dalal, Color Res. Appl. 30, 2005."""
    pairs = [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
    ]
    for one, other, expected in pairs:
        assert difference(np.array(one), np.array(other)) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("folder", parts.KIND_NAMES)
def test_every_page_has_equation_assumption_and_source(folder: str) -> None:
    pages = part_pages.pages(folder, {})
    overview = pages.pop(f"{folder}/index.md")
    assert len(pages) > 7
    for place, text in pages.items():
        assert f"({Path(place).name})" in overview
        for head in ("Equation", "What it assumes", "Source"):
            body = re.search(rf"^## {head}\n\n(.+?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
            assert body is not None, f"{place}: {head}"
            assert len(body[1].strip()) > 5


def test_docstrings_become_markdown() -> None:
    text = markdown("``x`` of :class:`~fusion_gym.core.task.Task`, :meth:`create`: x* - y, **no**")
    assert text == "`x` of [`Task`][fusion_gym.core.task.Task], `create`: x\\* - y, **no**"


def test_environment_pages_get_their_tables() -> None:
    assert places.pages_of().keys() == ENVIRONMENTS.keys()
    text = environment_pages.with_tables("# A page\n\nText.\n\n## One\n\nMore.\n", "biased")
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    assert heads[:3] == ["A page", "One", "From the code"]
    for name in ("BiasedOscillator-v0", "BiasedTracking-v0"):
        assert f"Options of {name}" in heads
        assert f"`fusion_gym/{name}`" in text.partition("## One")[0]
    assert re.search(r"\| `granted` +\| bool +\| \(2,\) +\|", text)


def test_links_lead_to_what_there_is() -> None:
    text = (
        "[a](step.md) [b](../results/README.md#overview) [c](../fusion_gym/linalg.py) "
        "[d](../nowhere.md) [e](https://example.org) ![f](../results/overview.png) "
        "[g](../results/bounds)"
    )
    changed = places.with_links(text, "docs/use.md", "use.md")
    assert changed == (
        "[a](step.md) [b](results/report.md#overview) "
        f"[c]({places.REPOSITORY}/blob/main/fusion_gym/linalg.py) [d](../nowhere.md) "
        "[e](https://example.org) ![f](results/overview.png) "
        f"[g]({places.REPOSITORY}/tree/main/results/bounds)"
    )
    assert places.with_links("[a](biased.md)", "docs/use.md", "x/y.md") == "[a](../biased.md)"


def test_the_navigation_has_every_page_once() -> None:
    def pages(tree: object) -> list[str]:
        if isinstance(tree, str):
            return [tree]
        parts_ = tree.values() if isinstance(tree, dict) else tree
        return [page for part in parts_ for page in pages(part)]  # type: ignore[union-attr]

    found = pages(navigation())
    assert len(found) == len(set(found))
    written = {str(path.relative_to(places.DOCS)) for path in places.DOCS.rglob("*.md")}
    assert written <= set(found)


def test_every_picture_in_the_docs_has_a_caption() -> None:
    texts = {path: path.read_text() for path in places.DOCS.rglob("*.md")}
    pictures = [
        (path, *one)
        for path, text in texts.items()
        for one in re.findall(r"!\[(.*?)\]\((\S+?)\)", text)
    ]
    assert len(pictures) > 8
    bare = [f"{path.name}: {target}" for path, caption, target in pictures if len(caption) < 15]
    assert not bare


def test_tutorials_show_pictures_and_import_what_they_use() -> None:
    tutorials = sorted((places.DOCS / "tutorials").glob("*.md"))
    assert len(tutorials) == 6
    for path in tutorials:
        text = path.read_text()
        blocks = re.findall(
            r"^```python exec=\"true\".*?\n(.*?)^```", text, re.DOTALL | re.MULTILINE
        )
        assert len(blocks) >= 4, path.name
        captions = re.findall(r"print\(figure_html\(figure\)\).*\n```\n\n\*(\w[^*]{40,})\*\n", text)
        assert len(captions) == text.count("print(figure_html(figure))") > 0, path.name
        compile("\n".join(blocks), path.name, "exec")
        assert "import fusion_gym" in text


def test_the_picture_of_the_step_is_that_of_its_script() -> None:
    from website import step_picture

    drawn = (places.DOCS / "pictures" / "step.svg").read_text()
    for word in (
        name for box in step_picture._BOXES.values() for name in (box[2], *box[3].split("\n"))
    ):
        assert f"<!-- {word} -->" in drawn


def simulated(colour: str, severity: float) -> np.ndarray:
    """Linear RGB as somebody with deuteranopia sees it, or as it is.

    The matrix is that of G. M. Machado, M. M. Oliveira and L. A. F. Fernandes, "A
    physiologically-based model for simulation of color vision deficiency", IEEE Trans.
    Visualization and Computer Graphics 15, 2009, for deuteranomaly of severity 1.
    """
    matrix = np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    )
    seen = matrix @ rgb(colour) if severity else rgb(colour)
    return np.clip(seen, 0.0, 1.0)


def rgb(colour: str) -> np.ndarray:
    """Linear RGB of a hexadecimal sRGB colour (IEC 61966-2-1)."""
    value = np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)]) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def lab(linear: np.ndarray) -> np.ndarray:
    """CIE 1976 L*a*b* of linear sRGB, white D65."""
    matrix = np.array(
        [
            [0.4124564, 0.3575761, 0.1804375],
            [0.2126729, 0.7151522, 0.0721750],
            [0.0193339, 0.1191920, 0.9503041],
        ]
    )
    ratio = matrix @ linear / matrix.sum(1)
    root = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    return np.array([116 * root[1] - 16, 500 * (root[0] - root[1]), 200 * (root[1] - root[2])])


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """ΔE of CIEDE2000 (G. Sharma, W. Wu and E. N. Dalal, Color Res. Appl. 30, 2005)."""
    chroma = np.mean([np.hypot(*one[1:]), np.hypot(*other[1:])])
    stretch = 1.5 - 0.5 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    (l1, c1, h1), (l2, c2, h2) = (_polar(colour, stretch) for colour in (one, other))
    turn = (h2 - h1 + 180.0) % 360.0 - 180.0 if c1 * c2 else 0.0
    light, mean = (l1 + l2) / 2, (c1 + c2) / 2
    if c1 * c2 == 0.0:
        hue = h1 + h2
    else:
        hue = (
            (h1 + h2) / 2
            if abs(h1 - h2) <= 180.0
            else (h1 + h2 + 360.0 * (1 if h1 + h2 < 360 else -1)) / 2
        )
    angle = np.deg2rad
    weight = (
        1.0 - 0.17 * np.cos(angle(hue - 30.0)) + 0.24 * np.cos(angle(2.0 * hue))
        + 0.32 * np.cos(angle(3.0 * hue + 6.0)) - 0.20 * np.cos(angle(4.0 * hue - 63.0))
    )  # fmt: skip
    parts_ = (
        (l2 - l1) / (1.0 + 0.015 * (light - 50.0) ** 2 / np.sqrt(20.0 + (light - 50.0) ** 2)),
        (c2 - c1) / (1.0 + 0.045 * mean),
        2.0 * np.sqrt(c1 * c2) * np.sin(angle(turn / 2.0)) / (1.0 + 0.015 * mean * weight),
    )
    bend = 30.0 * np.exp(-(((hue - 275.0) / 25.0) ** 2))
    cross = -2.0 * np.sqrt(mean**7 / (mean**7 + 25.0**7)) * np.sin(angle(2.0 * bend))
    return float(np.sqrt(sum(part**2 for part in parts_) + cross * parts_[1] * parts_[2]))


def _polar(colour: np.ndarray, stretch: float) -> tuple[float, float, float]:
    a, b = stretch * colour[1], colour[2]
    hue = float(np.degrees(np.arctan2(b, a)) % 360.0) if a or b else 0.0
    return float(colour[0]), float(np.hypot(a, b)), hue


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
    found = too_wide(tmp_path, str(shutil.which("chromium")))
    assert [line.partition(" ")[0] for line in found] == ["a.html"]
