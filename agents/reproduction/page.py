"""The pages of a reproduction: one a paper, with its figures and numbers, and one over all."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from PIL import Image

from ..output import palette
from ..output.files import replacing, write, write_text
from .paper import Paper
from .piece_result import Claim, Number, NumbersTable, Picture, PieceResult

TEXTS = Path(__file__).parent


def write_old_page(
    paper: Paper,
    value: Mapping[str, PieceResult],
    jobs: Mapping[str, Mapping[str, int]],
    output: Path,
) -> None:
    """A paper's pictures, its page and its numbers as JSON.

    ``jobs`` has episodes and seed of every piece.
    """
    for entry in value.values():
        for picture in entry.pictures:
            _draw(picture, output / paper.name)
    introduction = (TEXTS / paper.name / "introduction.md").read_text(encoding="utf-8")
    lines = [f"# {paper.title}", "", paper.citation, "", introduction.strip(), ""]
    claims = [claim for piece in value.values() for claim in piece.claims]
    lines += ["## Claims", "", *_claims(claims), ""]
    for piece in paper.pieces:
        entry, runs = value[piece.name], jobs[piece.name]
        lines += [f"## {piece.title}", ""]
        for note in entry.notes:
            lines += [note.strip(), ""]
        for table in entry.tables:
            lines += [*_table(table), ""]
        for picture in entry.pictures:
            path = f"{paper.name}/{picture.name}.png"
            lines += [
                f"### {picture.title}", "", f"![{picture.title}]({path})", "",
                f"*{picture.caption.strip()}*", "",
            ]  # fmt: skip
        lines += [f"({runs['episodes']:,} episodes, the first with seed {runs['seed']}.)", ""]
    lines += [f"Made by `fusion-gym reproduce {paper.name}`.", ""]
    write_text(output / f"{paper.name}.md", "\n".join(lines))
    write(output / f"{paper.name}.json", _numbers(paper, value, jobs))


def _draw(picture: Picture, folder: Path) -> None:
    with plt.rc_context(palette.READABLE):
        figure = plt.figure(figsize=picture.size, layout="constrained")
        try:
            picture.draw(figure)
            for suffix in ("png", "svg"):
                with replacing(folder / f"{picture.name}.{suffix}") as partial:
                    figure.savefig(partial, format=suffix, metadata=_UNDATED[suffix])
                    _SMALLER[suffix](partial)
        finally:
            plt.close(figure)


def _fewer_colours(png: Path) -> None:
    """A fourth of the size: drawings have few colours and their mixtures at edges.

    Maximum coverage keeps a thin line's colour, which a median cut gives up for more frequent ones.
    """
    with Image.open(png) as picture:
        full = picture.convert("RGB")
        small = full.quantize(_SHADES, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    small.save(png, format="png", optimize=True)


def _fewer_digits(svg: Path) -> None:
    """Paths to a hundredth of a point."""
    text = svg.read_text(encoding="utf-8")
    path = re.compile(r' d="[^"]*"')
    short = path.sub(lambda value: re.sub(r"(\.\d\d)\d+", r"\1", value.group()), text)
    svg.write_text(short, encoding="utf-8")


_SHADES = 128
_SMALLER = {"png": _fewer_colours, "svg": _fewer_digits}
_UNDATED: dict[str, dict[str, Any]] = {"png": {"Software": None}, "svg": {"Date": None}}


def _claims(claims: list[Claim]) -> list[str]:
    rows = [
        f"| {_cell(c.text)} | {_cell(c.source)} | **{c.verdict}** | {_cell(c.evidence)} |"
        for c in claims
    ]
    return ["| claim | where | verdict | evidence |", "|---|---|---|---|", *rows]


def _table(table: NumbersTable) -> list[str]:
    if table.columns:
        return _grid(table)
    rows = [
        f"| {_cell(n.what)} | {_printed(n)} | {_ours(n)} | {n.verdict} |" for n in table.numbers
    ]
    head = [f"**{table.title}**", "", "| | printed | ours (95 %) | verdict |", "|---|---|---|---|"]
    return [*head, *rows, *(["", table.note.strip()] if table.note else [])]


def _cell(text: str) -> str:
    """Text for a cell of a Markdown table."""
    return text.replace("|", "\\|")


def _grid(table: NumbersTable) -> list[str]:
    width = len(table.columns)
    lines = [table.numbers[first : first + width] for first in range(0, len(table.numbers), width)]
    rows = [
        " | ".join([f"| {_cell(line[0].what.rsplit(': ', 1)[0])}", *(_ours(n) for n in line)])
        + " |"
        for line in lines
    ]
    head = [f"**{table.title}** (95 %)", "", "| | " + " | ".join(table.columns) + " |"]
    return [*head, "|---" * (width + 1) + "|", *rows, *(["", table.note] if table.note else [])]


def _printed(number: Number) -> str:
    return "–" if number.printed is None else f"{number.printed:.4g} {number.unit}".strip()


def _ours(number: Number) -> str:
    exact = number.low == number.mean == number.high  # it depends on no draw
    interval = "" if exact else f" [{number.low:.4g}, {number.high:.4g}]"
    return f"{number.mean:.4g}{interval} {number.unit}".strip()


def _numbers(
    paper: Paper, pieces: Mapping[str, PieceResult], jobs: Mapping[str, Mapping[str, int]]
) -> dict[str, Any]:
    return {
        "paper": paper.name,
        "title": paper.title,
        "citation": paper.citation,
        "made": {name: dict(runs) for name, runs in jobs.items()},
        "tables": [
            {
                "piece": name,
                "name": table.name,
                "numbers": [n._asdict() | {"verdict": n.verdict} for n in table.numbers],
            }
            for name, piece in pieces.items()
            for table in piece.tables
        ],
        "claims": [claim._asdict() for piece in pieces.values() for claim in piece.claims],
    }
