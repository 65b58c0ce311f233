"""The command that makes papers anew: what it keeps, what it makes, its verdicts and its pages."""

import json
import math
import re
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import Ended, call
from hostile_folder import contents
from paths import ROOT

from agents.papers import page, paper
from agents.papers.claims import FAILS, HOLDS, Claim, Claims
from agents.papers.numbers import Number, below
from fusion_gym.validation import ConfigurationError

USUAL = 30
PIECES = ("first", "second")
Calls = list[tuple[str, int, int]]


TEMPLATE = """# The paper NAME

A. Author, “NAME”, 2020.

{% include "claims.md" %}

{{ table(first.tables.first) }}

{{ made.first }}

{{ table(second.tables.second) }}

{{ made.second }}

![Figure 5](NAME/figure_5.png)
"""


def a_paper(name: str, calls: Calls) -> paper.Paper:
    """A paper whose simulations are draws; it notes what is simulated in ``calls``."""

    def a_piece(piece: str) -> paper.Piece:
        def simulate(episodes: int, seed: int, settings: paper.Settings) -> paper.Data:
            calls.append((f"{name}/{piece}", episodes, seed))
            sample = np.random.default_rng(seed).normal(size=episodes)
            return {"sample": sample, "count": len(sample), "nested": {"list": [1.0, None]}}

        def summarise(data: paper.Data) -> paper.Data:
            assert data["nested"] == {"list": [1.0, None]}
            number = Number.from_sample(
                f"mean of {piece}", data["sample"], printed=0.0, runs=10, unit="m"
            )
            return {"name": piece, "tables": {piece: [number]}}

        simulate.__qualname__ = f"simulate_{name}_{piece}"
        return paper.Piece(piece, simulate, summarise, 1.0, USUAL)

    def draw(figure: Any, data: paper.Data) -> None:
        figure.subplots().plot(data["sample"])

    def test(first: Any) -> Any:
        return first.count > 0

    return paper.Paper(
        name, [a_piece(piece) for piece in PIECES],
        {"figure_5": paper.PaperFigure("first", draw, (2.0, 1.5))},
        claims=Claims(
            Claim(f"{name} claims | {piece}", "Section 1", "So says {first.name}.", test)
            for piece in PIECES
        ),
    )  # fmt: skip


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Calls:
    """Two papers, ``one`` and ``two``, instead of the real ones, in an empty folder."""
    folder, result = tmp_path, []
    texts = folder.with_name(f"{folder.name}_texts")
    texts.mkdir()
    for path in page.TEMPLATES.glob("*.md"):
        (texts / path.name).write_text(path.read_text())
    for name in ("one", "two"):
        (texts / f"{name}.md").write_text(TEMPLATE.replace("NAME", name))
        module = types.ModuleType(f"agents.papers.{name}")
        module.PAPER = a_paper(name, result)  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
    for module in (paper, page):
        monkeypatch.setattr(module, "NAMES", ("one", "two"))
    monkeypatch.setattr(page, "TEMPLATES", texts)
    monkeypatch.chdir(folder)
    return result


def reproduce(*words: str) -> Ended:
    """One process, for the papers are in this one alone."""
    ended = call("papers", [*words, "--workers", "1", "--output", "pages", "--work", "work"])
    assert ended.status == 0, (ended.err, ended.trace)
    return ended


def build_parts(calls: Calls) -> list[str]:
    """What was simulated since the last look."""
    names = [name for name, _, _ in calls]
    calls.clear()
    return names


def pages() -> dict[str, bytes | None]:
    return contents(Path("pages"))


# --- what is kept -------------------------------------------------------------------------------


def test_resume_keeps_what_is_finished(calls: Calls) -> None:
    reproduce("one")
    assert build_parts(calls) == ["one/first", "one/second"]
    before = pages()
    reproduce("one", "--resume")
    assert build_parts(calls) == []
    assert pages() == before
    reproduce("all", "--resume")
    assert build_parts(calls) == ["two/first", "two/second"]
    reproduce("one")  # without it everything is made
    assert build_parts(calls) == ["one/first", "one/second"]


@pytest.mark.parametrize(("episodes", "seed"), [(7, 0), (USUAL, 3)])
def test_resume_reproduces_other_inputs(calls: Calls, episodes: int, seed: int) -> None:
    reproduce("one")
    first = pages()
    calls.clear()
    reproduce("one", "--resume", "--episodes", str(episodes), "--seed", str(seed))
    assert calls == [("one/first", episodes, seed), ("one/second", episodes, seed)]
    assert pages() != first
    numbers = json.loads(Path("pages/one.json").read_text())
    assert numbers["made"]["first"] == {"episodes": episodes, "seed": seed}
    reproduce("one", "--resume")
    assert len(calls) == 2  # those with the first inputs are still there
    assert pages() == first


def test_resume_reproduces_what_is_damaged(calls: Calls) -> None:
    """Also beside files of another form and what a killed process left half-written."""
    reproduce("all")
    before = pages()
    calls.clear()
    entry = next(Path("work").rglob("output.pkl"))
    entry.write_bytes(entry.read_bytes()[:-40])
    entry.with_name("output.pkl.0123-45").write_bytes(b"half")
    Path("work/one").mkdir()
    Path("work/one/first.npz").write_bytes(b"an earlier version's")
    reproduce("all", "--resume")
    assert len(build_parts(calls)) == 1
    assert pages() == before


def test_a_piece_that_fails_leaves_the_others(
    calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(episodes: int, seed: int, settings: paper.Settings) -> paper.Data:
        raise ConfigurationError("threshold = 3 is not allowed")

    module = sys.modules["agents.papers.one"]
    first, second = module.PAPER.pieces
    bad = module.PAPER._replace(pieces=[first, second._replace(simulate=fail)])
    with monkeypatch.context() as patch:
        patch.setattr(module, "PAPER", bad)
        ended = call("papers", ["one", "--workers", "1", "--output", "pages", "--work", "work"])
        assert ended.status != 0
        assert "threshold = 3 is not allowed" in ended.err
    assert not Path("pages").exists() or pages() == {}
    calls.clear()
    reproduce("one", "--resume")
    assert build_parts(calls) == ["one/second"]


# --- verdicts -----------------------------------------------------------------------------------


def test_a_verdict_has_its_edge_where_it_says() -> None:
    """Both uncertainties are independent: their widths add up in squares."""
    edge = math.hypot(1.96 * 0.3, 0.25)
    for side in (-1.0, 1.0):
        inner = Number("x", 2.0, 1.75, 2.25, 2.0 + side * edge * (1 - 1e-9), 0.3)
        outer = Number("x", 2.0, 1.75, 2.25, 2.0 + side * edge * (1 + 1e-9), 0.3)
        assert (inner.verdict, outer.verdict) == ("agrees", "differs")
    assert Number("x", 2.0, 1.75, 2.25).verdict == "not printed"
    assert Number("x", 2.0, 2.0, 2.0, 2.0).verdict == "agrees"
    assert Number("x", 2.0, 2.0, 2.0, 2.001).verdict == "differs"


def test_numbers_of_a_sample_have_its_moments() -> None:
    sample = np.random.default_rng(0).normal(3.0, 2.0, size=2000)
    number = Number.from_sample("x", sample, 3.0, 25, "m")
    assert number.mean == pytest.approx(sample.mean())
    assert number.spread == pytest.approx(sample.std(ddof=1) / 5.0)
    half = 1.96 * sample.std(ddof=1) / np.sqrt(2000)
    ends = (number.high - number.mean, number.mean - number.low)
    assert ends == pytest.approx((half, half), rel=0.1)


@pytest.fixture
def undecided(calls: Calls) -> Calls:
    """The paper ``one`` has a claim that a hundred episodes decide."""

    @sys.modules["agents.papers.one"].PAPER.claims.add("Section 2")
    def test(first: Any) -> Any:
        """It is decided."""
        return first.count > 100 or below([-1, 1], 0)

    return calls


def test_an_undecided_claim_gets_five_times_the_episodes(undecided: Calls) -> None:
    reproduce("all")
    counts = [(name, episodes) for name, episodes, _ in undecided]
    first = [(f"{name}/{piece}", USUAL) for name in ("one", "two") for piece in PIECES]
    assert counts == [*first, *((f"one/{piece}", 5 * USUAL) for piece in PIECES)]
    numbers = json.loads(Path("pages/one.json").read_text())
    assert [claim["verdict"] for claim in numbers["claims"]] == [HOLDS] * 3
    assert numbers["made"]["first"]["episodes"] == 5 * USUAL


@pytest.mark.slow
def test_a_check_names_verdicts_that_contradict_the_pages(undecided: Calls) -> None:
    reproduce("all")
    undecided.clear()
    before = pages()
    assert "no verdict contradicts the pages" in reproduce("one", "--check").out
    assert undecided == [(f"one/{piece}", USUAL // 10, 0) for piece in PIECES]
    assert pages() == before
    path = Path("pages/one.json")
    path.write_text(path.read_text().replace(f'"verdict": "{HOLDS}"', f'"verdict": "{FAILS}"', 1))
    ended = call("papers", ["one", "--check", "--output", "pages", "--work", "work"])
    assert ended.status != 0
    assert f"one claims | first: {HOLDS}, not {FAILS}" in ended.err


# --- pages --------------------------------------------------------------------------------------


def test_pages_are_the_same_bytes_and_hold_no_path(calls: Calls, tmp_path: Path) -> None:
    folders = [tmp_path / "a", tmp_path / "deeper" / "b"]
    for folder in folders:
        words = ["--output", str(folder / "pages"), "--work", str(folder / "work")]
        assert call("papers", ["all", "--workers", "1", *words]).status == 0
    first, second = (contents(folder / "pages") for folder in folders)
    assert first == second
    assert {Path(name).suffix for name in first} == {"", ".md", ".json", ".png"}
    for name, raw in first.items():
        for hidden in (str(tmp_path), str(Path.home()), str(ROOT)):
            assert raw is None or hidden.encode() not in raw, name
        if raw is not None and name.endswith((".md", ".json")):
            assert not re.search(r"[\s\"'(]/\w+/", raw.decode()), name


def test_a_page_has_all_that_is_shown(calls: Calls) -> None:
    reproduce("one", "--episodes", "40", "--seed", "2")
    text, numbers = Path("pages/one.md").read_text(), json.loads(Path("pages/one.json").read_text())
    for figure in re.findall(r"!\[[^]]*\]\(([^)]*)\)", text):
        assert (Path("pages") / figure).is_file()
    assert text.count("(40 episodes, the first with seed 2.)") == 2
    assert len(numbers["claims"]) == len(re.findall(r"\| \*\*holds\*\* \|", text)) == 2
    sample = np.random.default_rng(2).normal(size=40)
    for table in numbers["tables"]:
        (entry,) = table["numbers"]
        expected = Number.from_sample(entry["what"], sample, 0.0, 10, "m")
        assert entry["mean"] == expected.mean
        assert entry["verdict"] == expected.verdict
        assert f"| {expected.mean:.4g} [{expected.low:.4g}, {expected.high:.4g}] m |" in text
    for line in text.splitlines():  # a bar in a cell makes no column
        if line.startswith("| one claims"):
            assert len(re.findall(r"(?<!\\)\|", line)) == 5


# --- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["three"], ["paper = 'three'", "one", "two", "all"]),
        (["one", "three"], ["paper = 'three'"]),
        ([], ["papers", "one", "two", "all"]),
        (["one", "--episodes", "1"], ["episodes = 1", "2"]),
    ],
)
def test_one_clear_error_before_anything_runs(
    calls: Calls, words: list[str], text: list[str]
) -> None:
    ended = call("papers", words)
    assert ended.status != 0
    assert ended.trace == ""
    (line,) = ended.err.splitlines()
    assert line.startswith("error: ")
    assert all(part in line for part in text), line
    assert calls == []
    assert contents(Path()) == {}
