"""What the tests of reproduced papers share: a fresh quick run beside the committed page.

The fresh run has few episodes and another seed. Each of its numbers must lie within 4.5 standard
errors of the committed one, both samples together. The standard error of an episode's mean is that
of the committed sample, from its 95 % interval: the fresh one is too small to tell its own.
"""

import json
import math
from pathlib import Path
from typing import Any

from fusion_gym.agents.output import palette
from fusion_gym.agents.papers.page import draw_figure, render_page
from fusion_gym.agents.papers.paper import Data, Paper

PAGES = Path(__file__).parents[1] / "docs" / "reproduction"
ERRORS = 4.5  # of both samples together
SEED = 1_000_000
PNG, SVG = 100_000, 200_000  # bytes of a figure


def committed(name: str) -> dict[str, Any]:
    """The numbers of the committed page of a paper."""
    content: dict[str, Any] = json.loads((PAGES / f"{name}.json").read_text(encoding="utf-8"))
    return content


def quick(paper: Paper, episodes: int) -> tuple[dict[str, Any], dict[str, Data]]:
    """The numbers of the page of a fresh run, and its data, read as the command does it."""
    settings, data, counts = paper.settings({}), {}, {}
    for piece in paper.pieces:
        result = piece.simulate(episodes, SEED, settings)
        plain = {name: value for name, value in result.items() if not hasattr(value, "dtype")}
        data[piece.name] = result | json.loads(json.dumps(plain))
        counts[piece.name] = {"episodes": episodes, "seed": SEED}
    return render_page(paper, data, counts)[1], data


def check_numbers(
    page: dict[str, Any], fresh: dict[str, Any], episodes: int, slack: float = 1e-9
) -> None:
    """Hold every number to the committed one.

    ``slack`` is what else a number may be off, relative to its size (or absolute below 1).
    """
    far = []
    for table, others in zip(page["tables"], fresh["tables"], strict=True):
        assert (table["piece"], table["name"]) == (others["piece"], others["name"])
        ratio = page["made"][table["piece"]]["episodes"] / episodes
        for old, new in zip(table["numbers"], others["numbers"], strict=True):
            assert (new["what"], new["printed"]) == (old["what"], old["printed"])
            deviation = (old["high"] - old["low"]) / 3.92 * math.sqrt(1.0 + ratio)
            allowed = ERRORS * deviation + slack * max(1.0, abs(old["mean"]))
            if not abs(new["mean"] - old["mean"]) <= allowed:
                far.append(f"{old['what']}: {new['mean']:.6g}, not {old['mean']:.6g} ± {allowed}")
    assert not far, "\n".join(far)


def check_claims(
    page: dict[str, Any], fresh: dict[str, Any], name: str, uncertain: tuple[str, ...] = ()
) -> None:
    """The same claims; the page's verdicts are the JSON's, and those of the fresh run.

    The verdicts of claims whose texts begin with one of ``uncertain`` need more episodes.
    """
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    differing = []
    for old, new in zip(page["claims"], fresh["claims"], strict=True):
        assert new["text"] == old["text"]
        beginning = f"| {old['text']} | {old['source']} | ".replace("\\", "")
        assert f"{beginning}**{old['verdict']}** | " in text.replace("\\|", "|"), old["text"]
        if not old["text"].startswith(uncertain or ("\0",)) and new["verdict"] != old["verdict"]:
            differing.append(f"{old['text']}: {new['verdict']}, not {old['verdict']}")
    assert not differing, "\n".join(differing)


def check_pictures(paper: Paper, data: dict[str, Data]) -> None:
    """Every figure draws, and its files are there and small."""
    for figure in paper.figures.values():
        drawing = draw_figure(figure, data[figure.piece])
        drawing.draw_without_rendering()
        assert drawing.axes
        palette.plt.close(drawing)
    for suffix, most in (("png", PNG), ("svg", SVG)):
        there = {p.stem: p.stat().st_size for p in (PAGES / paper.name).glob(f"*.{suffix}")}
        assert set(there) == set(paper.figures)
        assert max(there.values()) <= most, there
