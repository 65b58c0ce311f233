"""The pages of a reproduction: Markdown and JSON of a paper, its pictures, and the overview."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2
import matplotlib.pyplot as plt
from PIL import Image

from agents.papers.numbers import below, cite, estimate, number_text, percent, verdict
from agents.papers.paper import NAMES, Data, Paper, PaperFigure
from fusion_gym.entries import Plain
from fusion_gym.output import palette
from fusion_gym.output.files import read_json, replacing, write, write_text

OVERVIEW = "README.md"
TEMPLATES = Path(__file__).parent
Counts = Mapping[str, Mapping[str, int]]  # episodes and seed of each piece


def render_page(paper: Paper, results: Mapping[str, Data], counts: Counts) -> tuple[str, Plain]:
    """Return a paper's Markdown from the data of all its pieces, and its numbers as plain JSON."""
    pieces = {
        piece.name: results[piece.name] | piece.summarise(results[piece.name])
        for piece in paper.pieces
    }
    claims: list[dict[str, str]] = []

    def claim(text: str, source: str, parts: Any, caller: Callable[[], str]) -> str:
        result = parts if isinstance(parts, str) else verdict(parts)
        row = {"text": text, "source": source, "verdict": result, "evidence": caller()}
        claims.append({name: _line(value) for name, value in row.items()})
        cells = claims[-1] | {"verdict": f"**{result}**"}
        return f"| {' | '.join(map(_cell, cells.values()))} |\n"

    template = _template(f"{paper.name}.md")
    text = template.render(pieces, paper=paper.name, claim=claim, counts=counts)
    lines = text.splitlines()
    tables = [
        {
            "piece": name,
            "name": table,
            "numbers": [n._asdict() | {"verdict": n.verdict} for n in numbers],
        }
        for name, piece in pieces.items()
        for table, numbers in piece.get("tables", {}).items()
    ]
    return text, {
        "paper": paper.name,
        "title": lines[0].removeprefix("# "),
        "citation": lines[2],
        "made": {name: dict(count) for name, count in counts.items()},
        "tables": tables,
        "claims": claims,
    }


def write_page(paper: Paper, results: Mapping[str, Data], counts: Counts, output: Path) -> None:
    """Write a paper's pictures, its page and its numbers."""
    text, numbers = render_page(paper, results, counts)
    for name, figure in paper.figures.items():
        write_figure(figure, results[figure.piece], output / paper.name / name)
    write_text(output / f"{paper.name}.md", text)
    write(output / f"{paper.name}.json", numbers)


def write_overview(output: Path) -> None:
    """Write the page over all papers with stored numbers."""
    paths = [output / f"{name}.json" for name in NAMES]
    papers = [read_json(path, "numbers") for path in paths if path.exists()]
    for paper in papers:
        verdicts = [n["verdict"] for table in paper["tables"] for n in table["numbers"]]
        paper |= {word: verdicts.count(word) for word in ("agrees", "differs")}
    write_text(output / OVERVIEW, _template("overview.md").render(papers=papers))


def _template(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "cell": _cell, "cite": cite, "line": _line, "number": number_text, "percent": percent,
    }  # fmt: skip
    environment.globals |= {"below": below, "estimate": estimate}
    return environment.get_template(name)


def _line(text: str) -> str:
    return " ".join(text.split())


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def draw_figure(figure: PaperFigure, data: Data) -> Any:
    """Return a matplotlib Figure, which the caller closes, in the style of the pages."""
    with plt.rc_context(palette.READABLE):
        result = plt.figure(figsize=figure.size, layout="constrained")
        try:
            figure.draw(result, data)
        except BaseException:
            plt.close(result)
            raise
        return result


def write_figure(figure: PaperFigure, data: Data, path: Path) -> None:
    """Write a figure as PNG and SVG; the path has no suffix."""
    drawing = draw_figure(figure, data)
    with plt.rc_context(palette.READABLE):
        try:
            for suffix in ("png", "svg"):
                with replacing(path.with_name(f"{path.name}.{suffix}")) as partial:
                    drawing.savefig(partial, format=suffix, metadata=_UNDATED[suffix])
                    _SMALLER[suffix](partial)
        finally:
            plt.close(drawing)


def _fewer_colours(png: Path) -> None:
    """Reduce the file to a fourth of its size by a palette.

    Maximum coverage keeps a thin line's colour, unlike a median cut.
    """
    with Image.open(png) as picture:
        full = picture.convert("RGB")
        small = full.quantize(_SHADES, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    small.save(png, format="png", optimize=True)


def _fewer_digits(svg: Path) -> None:
    """Round paths to a hundredth of a point."""
    text = svg.read_text(encoding="utf-8")
    path = re.compile(r' d="[^"]*"')
    short = path.sub(lambda value: re.sub(r"(\.\d\d)\d+", r"\1", value.group()), text)
    svg.write_text(short, encoding="utf-8")


_SHADES = 128
_SMALLER = {"png": _fewer_colours, "svg": _fewer_digits}
_UNDATED: dict[str, Plain] = {"png": {"Software": None}, "svg": {"Date": None}}
