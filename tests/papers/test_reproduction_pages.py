"""Every reproduced paper's page against a fresh quick run: numbers, claims and figures.

The fresh run has few episodes and another seed. Each of its numbers must lie within 4.5 standard
errors of the committed one, both samples together. The standard error of an episode's mean is that
of the committed sample, from its 95 % interval: the fresh one is too small to tell its own.
"""

import json
import math
import re
from typing import Any

import pytest
from paths import ROOT

from agents.papers.claims import UNDECIDED
from agents.papers.page import render_page
from agents.papers.paper import NAMES, Data, Paper, load_paper

PAGES = ROOT / "docs" / "reproduction"
ERRORS = 4.5  # of both samples together
SLACK = 1e-9  # what else a number may be off, relative to its size (or absolute below 1)
SEED = 1_000_000
MOST = 100_000  # bytes of a figure


def quick(paper: Paper, episodes: int) -> tuple[dict[str, Any], dict[str, Data]]:
    """The numbers of the page of a fresh run, and its data, read as the command does it."""
    results: dict[str, dict[str, Data]] = {}
    for reading, changes in paper.readings.items():
        results[reading] = data = {}
        for piece in paper.pieces:
            result = piece.simulate(episodes, SEED, paper.settings(changes))
            plain = {name: value for name, value in result.items() if not hasattr(value, "dtype")}
            data[piece.name] = result | json.loads(json.dumps(plain))
    counts = {piece.name: {"episodes": episodes, "seed": SEED} for piece in paper.pieces}
    return render_page(paper, results, counts)[1], results[next(iter(paper.readings))]


def check_numbers(page: dict[str, Any], fresh: dict[str, Any], episodes: int) -> None:
    """Hold every number to the committed one."""
    far = []
    for table, others in zip(page["tables"], fresh["tables"], strict=True):
        assert (table["piece"], table["name"]) == (others["piece"], others["name"])
        ratio = page["made"][table["piece"]]["episodes"] / episodes
        for old, new in zip(table["numbers"], others["numbers"], strict=True):
            assert (new["what"], new["printed"]) == (old["what"], old["printed"])
            deviation = (old["high"] - old["low"]) / 3.92 * math.sqrt(1.0 + ratio)
            allowed = ERRORS * deviation + SLACK * max(1.0, abs(old["mean"]))
            if not abs(new["mean"] - old["mean"]) <= allowed:
                far.append(f"{old['what']}: {new['mean']:.6g}, not {old['mean']:.6g} ± {allowed}")
    assert not far, "\n".join(far)


def check_claims(page: dict[str, Any], fresh: dict[str, Any], name: str) -> None:
    """The same claims; the page's verdicts are the JSON's, and a fresh run's unless undecided."""
    text = re.sub(" +", " ", (PAGES / f"{name}.md").read_text(encoding="utf-8"))
    differing = []
    for old, new in zip(page["claims"], fresh["claims"], strict=True):
        assert new["text"] == old["text"]
        beginning = f"| {old['text']} | {old['source']} | ".replace("\\", "")
        assert f"{beginning}**{old['verdict']}**" in text.replace("\\|", "|"), old["text"]
        if UNDECIDED not in (old["verdict"], new["verdict"]) and new["verdict"] != old["verdict"]:
            differing.append(f"{old['text']}: {new['verdict']}, not {old['verdict']}")
    assert not differing, "\n".join(differing)


def check_pictures(paper: Paper, data: dict[str, Data]) -> None:
    """Every figure draws, and its file is there and small."""
    for figure in paper.figures.values():
        drawing = figure.draw_data(data[figure.piece])
        drawing.draw_without_rendering()
        assert drawing.axes
    there = {path.stem: path.stat().st_size for path in (PAGES / paper.name).iterdir()}
    assert set(there) == set(paper.figures)
    assert max(there.values()) <= MOST, there


EPISODES = {
    "tobit_token_bucket": 40, "adaptive_innovation": 12, "markov_jump": 30, "unknown_input": 24,
    "round_robin_tobit": 24,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_page_is_that_of_a_fresh_run(name: str) -> None:
    episodes = EPISODES[name]
    paper, page = load_paper(name), json.loads((PAGES / f"{name}.json").read_text(encoding="utf-8"))
    fresh, data = quick(paper, episodes)
    check_numbers(page, fresh, episodes)
    check_claims(page, fresh, name)
    check_pictures(paper, data)
