"""What the tests of reproduced papers share: a fresh quick run beside the committed page.

The fresh run has few episodes and another seed. Each of its numbers must lie within 4.5 standard
errors of the committed one, both samples together. The standard error of an episode's mean is that
of the committed sample, from its 95 % interval: the fresh one is too small to tell its own.
"""

import json
import math
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from fusion_gym.agents.output import palette
from fusion_gym.agents.reproduction.paper import Paper
from fusion_gym.agents.reproduction.piece_result import PieceResult

PAGES = Path(__file__).parents[1] / "docs" / "reproduction"
ERRORS = 4.5  # of both samples together
SEED = 1_000_000
PNG, SVG = 100_000, 200_000  # bytes of a figure


def committed(name: str) -> dict[str, Any]:
    """The numbers of the committed page of a paper."""
    content: dict[str, Any] = json.loads((PAGES / f"{name}.json").read_text(encoding="utf-8"))
    return content


def quick(paper: Paper, episodes: int) -> dict[str, PieceResult]:
    """What a fresh run of every piece shows, kept and read as the command does it."""
    result = {}
    for piece in paper.pieces:
        computed = piece.compute(episodes, SEED)
        plain = {name: value for name, value in computed.items() if not hasattr(value, "dtype")}
        result[piece.name] = piece.show(computed | json.loads(json.dumps(plain)))
    return result


def check_numbers(
    page: dict[str, Any], fresh: dict[str, PieceResult], episodes: int, slack: float = 1e-9
) -> int:
    """Hold every number to the committed one; how many there are.

    ``slack`` is what else a number may be off, relative to its size (or absolute below 1).
    """
    tables = {(piece, t.name): t for piece, entry in fresh.items() for t in entry.tables}
    assert set(tables) == {(t["piece"], t["name"]) for t in page["tables"]}
    count, far = 0, []
    for table in page["tables"]:
        numbers = tables[table["piece"], table["name"]].numbers
        assert [n.what for n in numbers] == [n["what"] for n in table["numbers"]]
        ratio = page["made"][table["piece"]]["episodes"] / episodes
        for old, new in zip(table["numbers"], numbers, strict=True):
            assert new.printed == old["printed"]
            deviation = (old["high"] - old["low"]) / 3.92 * math.sqrt(1.0 + ratio)
            allowed = ERRORS * deviation + slack * max(1.0, abs(old["mean"]))
            if not abs(new.mean - old["mean"]) <= allowed:
                far.append(f"{old['what']}: {new.mean:.6g}, not {old['mean']:.6g} ± {allowed:.2g}")
            count += 1
    assert not far, "\n".join(far)
    return count


def check_claims(
    page: dict[str, Any], fresh: dict[str, PieceResult], name: str, uncertain: tuple[str, ...] = ()
) -> None:
    """The same claims; the page's verdicts are the JSON's, and those of the fresh run.

    The verdicts of claims whose texts begin with one of ``uncertain`` need more episodes.
    """
    claims = [claim for piece in fresh.values() for claim in piece.claims]
    assert [c.text for c in claims] == [c["text"] for c in page["claims"]]
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    differing = []
    for old, new in zip(page["claims"], claims, strict=True):
        beginning = f"| {old['text']} | {old['source']} | ".replace("\\", "")
        assert f"{beginning}**{old['verdict']}** | " in text.replace("\\|", "|"), old["text"]
        if not old["text"].startswith(uncertain or ("\0",)) and new.verdict != old["verdict"]:
            differing.append(f"{old['text']}: {new.verdict}, not {old['verdict']}")
    assert not differing, "\n".join(differing)


def check_pictures(fresh: dict[str, PieceResult], name: str) -> int:
    """Every figure draws, and its files are there and small; how many there are."""
    pictures = [picture for piece in fresh.values() for picture in piece.pictures]
    files = {picture.name for picture in pictures}
    assert len(files) == len(pictures)
    with palette.plt.rc_context(palette.READABLE):
        for picture in pictures:
            figure = Figure(figsize=picture.size, layout="constrained")
            picture.draw(figure)
            figure.draw_without_rendering()
            assert figure.axes
    for suffix, most in (("png", PNG), ("svg", SVG)):
        there = {path.stem: path.stat().st_size for path in (PAGES / name).glob(f"*.{suffix}")}
        assert set(there) == files
        assert max(there.values()) <= most, there
    return len(pictures)
