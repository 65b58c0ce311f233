"""The command that makes papers anew: what it keeps, what it makes, its verdicts and its pages."""

import json
import math
import re
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import Ended, call
from hostile_folder import contents
from scipy import stats

from fusion_gym.agents.reproduction import page, papers
from fusion_gym.agents.reproduction.making import PieceJob, compute_jobs
from fusion_gym.agents.reproduction.paper import Paper, Piece
from fusion_gym.agents.reproduction.piece_result import (
    Claim,
    Number,
    NumbersTable,
    Picture,
    PieceResult,
)
from fusion_gym.validation import ConfigurationError

USUAL = 30
PIECES = ("first", "second")
Calls = list[tuple[str, int, int]]


def a_paper(name: str, calls: Calls, drawn: bool) -> Paper:
    """A paper whose simulations are draws; it notes what is simulated in ``calls``.

    With ``drawn`` it has a figure.
    """

    def computing(piece: str) -> Callable[[int, int], dict[str, Any]]:
        def compute(episodes: int, seed: int) -> dict[str, Any]:
            calls.append((f"{name}/{piece}", episodes, seed))
            sample = np.random.default_rng(seed).normal(size=episodes)
            return {"sample": sample, "count": len(sample), "nested": {"list": [1.0, None]}}

        return compute

    def showing(piece: str) -> Callable[[dict[str, Any]], PieceResult]:
        def show(stored: dict[str, Any]) -> PieceResult:
            assert stored["nested"] == {"list": [1.0, None]}
            number = Number.of(f"mean of {piece}", stored["sample"], printed=0.0, runs=10, unit="m")
            picture = Picture(
                f"figure_{piece}", f"Figure of {piece}", "What to see.",
                lambda figure: figure.subplots().plot(stored["sample"]), (2.0, 1.5),
            )  # fmt: skip
            pictures = [picture] if drawn and piece == "first" else []
            evidence = f"{stored['count']} drawn"
            claim = Claim(f"{name} claims | {piece}", "Section 1", "holds", evidence)
            return PieceResult(
                pictures, [NumbersTable(piece, f"Table of {piece}", [number])], [claim], ["So."]
            )

        return show

    return Paper(
        name, f"The paper {name}", f"A. Author, “{name}”, 2020.",
        [Piece(row, f"Piece {row}", computing(row), showing(row), 1.0, USUAL) for row in PIECES],
    )  # fmt: skip


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Calls:
    """Two papers, ``one`` and ``two``, instead of the real ones, in an empty folder."""
    return put(monkeypatch, tmp_path, drawn=False)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Calls:
    """The same with figures."""
    return put(monkeypatch, tmp_path, drawn=True)


def put(monkeypatch: pytest.MonkeyPatch, folder: Path, drawn: bool) -> Calls:
    result: Calls = []
    texts = folder.with_name(f"{folder.name}_texts")
    for name in ("one", "two"):
        (texts / name).mkdir(parents=True)
        (texts / name / "introduction.md").write_text("Words.")
        module = types.ModuleType(f"fusion_gym.agents.reproduction.{name}.pieces")
        module.PAPER = a_paper(name, result, drawn)  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
    for module in (papers, page):
        monkeypatch.setattr(module, "NAMES", ("one", "two"))
    (texts / "overview.md").write_text("# The papers\n")
    monkeypatch.setattr(page, "TEXTS", texts)
    monkeypatch.chdir(folder)
    return result


def reproduce(*words: str) -> Ended:
    """One process, for the papers are in this one alone."""
    ended = call("reproduce", [*words, "--workers", "1", "--output", "pages", "--work", "work"])
    assert ended.status == 0, (ended.err, ended.trace)
    return ended


def build_parts(calls: Calls) -> list[str]:
    """What was simulated since the last look."""
    names = [name for name, _, _ in calls]
    calls.clear()
    return names


def pages(start: str = "") -> dict[str, bytes | None]:
    result = contents(Path("pages"))
    return {name: raw for name, raw in result.items() if name.startswith(start)}


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


@pytest.mark.parametrize("words", [["--episodes", "7"], ["--seed", "3"]])
def test_resume_reproduces_what_was_made_otherwise(calls: Calls, words: list[str]) -> None:
    reproduce("one")
    first = pages()
    calls.clear()
    reproduce("one", "--resume", *words)
    episodes, seed = (7, 0) if words[0] == "--episodes" else (USUAL, 3)
    assert calls == [("one/first", episodes, seed), ("one/second", episodes, seed)]
    assert pages() != first
    numbers = json.loads(Path("pages/one.json").read_text())
    assert numbers["made"]["first"] == {"episodes": episodes, "seed": seed}
    reproduce("one", "--resume")
    assert len(calls) == 4
    assert pages() == first


def robbed(path: Path) -> None:
    with np.load(path) as arrays:
        names = {name: arrays[name] for name in arrays.files if name != "plain"}
    np.savez(path, **names)


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-40]),
    "overwritten": lambda path: path.write_bytes(b"\x00\xff" * 500),
    "robbed": robbed,
    "removed": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_resume_reproduces_what_is_damaged(calls: Calls, damage: Callable[[Path], None]) -> None:
    reproduce("all")
    before = pages()
    calls.clear()
    damage(Path("work/one/second.npz"))
    reproduce("all", "--resume")
    assert build_parts(calls) == ["one/second"]
    assert pages() == before


def test_what_a_killed_process_left_is_removed(calls: Calls) -> None:
    Path("work/one").mkdir(parents=True)
    left = Path("work/one/first.123.part.npz")
    left.write_bytes(b"half")
    reproduce("one", "--resume")
    assert build_parts(calls) == ["one/first", "one/second"]
    assert not left.exists()


def test_what_is_read_is_what_was_computed(calls: Calls, tmp_path: Path) -> None:
    job = PieceJob("one", "first", 5, 11, tmp_path)
    assert not job.finished()
    with pytest.raises(FileNotFoundError):
        job.read()
    compute_jobs(job)
    result = job.read()
    np.testing.assert_array_equal(result["sample"], np.random.default_rng(11).normal(size=5))
    assert result.keys() == {"sample", "count", "nested"}
    other = PieceJob("one", "first", 6, 11, tmp_path)
    with pytest.raises(ConfigurationError, match="made from something else"):
        other.read()
    assert not other.finished()


def test_a_piece_that_fails_leaves_the_others(
    calls: Calls, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(episodes: int, seed: int) -> dict[str, Any]:
        raise ConfigurationError("threshold = 3 is not allowed")

    good = sys.modules["fusion_gym.agents.reproduction.one.pieces"].PAPER
    first, second = good.pieces
    bad = Piece("second", second.title, fail, second.show, 1.0, USUAL)
    broken = Paper(good.name, good.title, good.citation, [first, bad])
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["fusion_gym.agents.reproduction.one.pieces"], "PAPER", broken)
        ended = call("reproduce", ["one", "--workers", "1", "--output", "pages", "--work", "work"])
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


@pytest.mark.parametrize(("runs", "episodes"), [(1, 1000), (1000, 100)])
def test_true_reprints_agree_in_95_of_100(runs: int, episodes: int) -> None:
    """Gaussian papers with known deviation: the coverage is 95 %, 4.5 errors of 5,000 papers.

    And a printed value that is off by four deviations of the difference agrees in 2.1 %.
    """
    rng, count, deviation = np.random.default_rng(runs), 5_000, 1.7
    ours = rng.normal(scale=deviation / np.sqrt(episodes), size=count)
    theirs = rng.normal(scale=deviation / np.sqrt(runs), size=count)
    half, spread = 1.96 * deviation / np.sqrt(episodes), deviation / np.sqrt(runs)
    off = 4.0 * math.hypot(deviation / np.sqrt(episodes), spread)
    for shift in (0.0, off):
        agreed = np.mean(
            [
                Number("x", our, our - half, our + half, other + shift, spread).verdict == "agrees"
                for our, other in zip(ours, theirs, strict=True)
            ]
        )
        distance = 4.0 if shift else 0.0
        expected = stats.norm.cdf(1.96 - distance) - stats.norm.cdf(-1.96 - distance)
        error = np.sqrt(expected * (1.0 - expected) / count)
        assert agreed == pytest.approx(expected, abs=4.5 * error)


def test_numbers_of_a_sample_have_its_moments() -> None:
    sample = np.random.default_rng(0).normal(3.0, 2.0, size=2000)
    number = Number.of("x", sample, 3.0, 25, "m")
    assert number.mean == pytest.approx(sample.mean())
    assert number.spread == pytest.approx(sample.std(ddof=1) / 5.0)
    half = 1.96 * sample.std(ddof=1) / np.sqrt(2000)
    assert number.high - number.mean == pytest.approx(half, rel=0.1)
    assert number.mean - number.low == pytest.approx(half, rel=0.1)


# --- pages --------------------------------------------------------------------------------------


def test_pages_are_the_same_bytes_and_hold_no_path(drawn: Calls, tmp_path: Path) -> None:
    folders = [tmp_path / "a", tmp_path / "deeper" / "b"]
    for folder in folders:
        words = ["--output", str(folder / "pages"), "--work", str(folder / "work")]
        assert call("reproduce", ["all", "--workers", "1", *words]).status == 0
    first, second = (contents(folder / "pages") for folder in folders)
    assert first == second
    assert {Path(name).suffix for name in first} == {"", ".md", ".json", ".png", ".svg"}
    for name, raw in first.items():
        for hidden in (str(tmp_path), str(Path.home()), str(Path(__file__).parents[1])):
            assert raw is None or hidden.encode() not in raw, name
        if raw is not None and name.endswith((".md", ".json")):
            assert not re.search(r"[\s\"'(]/\w+/", raw.decode()), name


def test_a_page_has_all_that_is_shown(drawn: Calls) -> None:
    reproduce("one", "--episodes", "40", "--seed", "2")
    text, numbers = Path("pages/one.md").read_text(), json.loads(Path("pages/one.json").read_text())
    for figure in re.findall(r"!\[[^]]*\]\(([^)]*)\)", text):
        assert (Path("pages") / figure).is_file()
        assert (Path("pages") / figure).with_suffix(".svg").is_file()
    assert text.count("(40 episodes, the first with seed 2.)") == 2
    assert len(numbers["claims"]) == len(re.findall(r"\| \*\*holds\*\* \|", text)) == 2
    sample = np.random.default_rng(2).normal(size=40)
    for table in numbers["tables"]:
        (entry,) = table["numbers"]
        expected = Number.of(entry["what"], sample, 0.0, 10, "m")
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
    ended = call("reproduce", words)
    assert ended.status != 0
    assert ended.trace == ""
    (line,) = ended.err.splitlines()
    assert line.startswith("error: ")
    assert all(part in line for part in text), line
    assert calls == []
    assert contents(Path()) == {}
