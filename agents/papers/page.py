"""The pages of a reproduction: Markdown and JSON of a paper, its pictures, and the overview."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2
import matplotlib.pyplot as plt

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
        finally:
            plt.close(drawing)


_UNDATED: dict[str, Plain] = {"png": {"Software": None}, "svg": {"Date": None}}
