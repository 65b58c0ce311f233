"""The pages of a reproduction: Markdown and JSON of a paper, its pictures, and the overview."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import jinja2
import matplotlib.pyplot as plt
from PIL import Image

from agents.papers import numbers
from agents.papers.claims import Judgement
from agents.papers.numbers import Number
from agents.papers.paper import NAMES, Data, Paper, PieceData
from fusion_gym.docstrings import table
from fusion_gym.entries import Plain
from fusion_gym.output import palette
from fusion_gym.output.files import read_json, replacing, write, write_text

_COLOURS = 64  # of a PNG, a third of the bytes of all
_MADE = "({episodes:,} episodes, the first with seed {seed}.)"
TEMPLATES = Path(__file__).parent
Counts = Mapping[str, Mapping[str, int]]  # episodes and seed of each piece
Results = Mapping[str, Mapping[str, Data]]  # of the pieces, by reading


def render_page(paper: Paper, results: Results, counts: Counts) -> tuple[str, Plain]:
    """Return a paper's Markdown from the data of all its pieces, and its numbers as plain JSON."""
    runs = {
        reading: {
            piece.name: PieceData(
                data[piece.name] | piece.summarise(data[piece.name]),
                episodes=counts[piece.name]["episodes"],
            )
            for piece in paper.pieces
        }
        for reading, data in results.items()
    }
    own = next(iter(runs.values()))
    judgements = [claim.judge(runs) for claim in paper.claims]
    text = _template(f"{paper.name}.md").render(
        own | dict(paper.texts(runs)),
        claims=_claims_table(judgements),
        claims_by_reading=_readings_table(judgements, [*runs]),
        made={name: _MADE.format(**count) for name, count in counts.items()},
    )
    lines = text.splitlines()
    return text, {
        "paper": paper.name,
        "title": lines[0].removeprefix("# "),
        "citation": lines[2],
        "made": {name: dict(count) for name, count in counts.items()},
        "tables": [
            {
                "piece": piece.name,
                "name": name,
                "numbers": [n._asdict() | {"verdict": n.verdict} for n in entries],
            }
            for piece in paper.pieces
            for name, entries in own[piece.name].get("tables", {}).items()
        ],
        "claims": [
            {
                "text": claim.text,
                "source": claim.source,
                "verdict": verdict,
                "evidence": evidence,
            }
            for claim, verdict, evidence, _ in judgements
        ],
    }


def _claims_table(judgements: Iterable[Judgement]) -> str:
    return table(
        ("claim", "where", "verdict", "evidence"),
        [
            (own.claim.text, own.claim.source, f"**{own.verdict}**{own.region}", own.evidence)
            for own in judgements
        ],
    )


def _readings_table(judgements: Iterable[Judgement], readings: Sequence[str]) -> str:
    """Return how many claims hold together under each reading."""
    every = [own.outcomes for own in judgements if set(own.outcomes) == set(readings)]
    held = {name: sum(outcomes[name] == 1.0 for outcomes in every) for name in readings}
    rows = [(name, f"{count}") for name, count in held.items()]
    rows[0] = f"{readings[0]} (the environment)", rows[0][1]
    return table(("reading", "claims that hold"), rows)


def _number_table(numbers: Iterable[Number]) -> str:
    rows = [(n.what, n.printed_text, n.text, n.verdict) for n in numbers]
    return table(("", "printed", "ours (95 %)", "verdict"), rows)


def _grid_table(numbers: Iterable[Number]) -> str:
    """Return the table of numbers named "row: column"."""
    rows = defaultdict[str, dict[str, str]](dict)
    for number in numbers:
        row, _, column = number.what.rpartition(": ")
        rows[row][column] = number.text
    columns = tuple(next(iter(rows.values())))
    return table(("", *columns), [(row, *cells.values()) for row, cells in rows.items()])


def write_page(paper: Paper, results: Results, counts: Counts, output: Path) -> Plain:
    """Write a paper's figures, its page and its numbers, and return the numbers."""
    text, content = render_page(paper, results, counts)
    for name, figure in paper.figures.items():
        path = output / paper.name / f"{name}.png"
        with plt.rc_context(palette.READABLE), replacing(path) as partial:
            drawing = figure.draw_data(results[next(iter(paper.readings))][figure.piece])
            drawing.savefig(partial, format="png")
            with Image.open(partial) as picture:
                reduced = picture.convert("RGB").quantize(_COLOURS)
            reduced.save(partial, "PNG", optimize=True)
    write_text(output / f"{paper.name}.md", text)
    write(output / f"{paper.name}.json", content)
    return content


def write_overview(output: Path) -> None:
    """Write the page over all papers with stored numbers."""
    paths = [output / f"{name}.json" for name in NAMES]
    papers = [read_json(path, "numbers") for path in paths if path.exists()]
    sections = "\n\n".join(map(_section, papers))
    write_text(output / "README.md", _template("overview.md").render(papers=sections))


def _section(paper: Plain) -> str:
    """Return the overview's section on a paper."""
    verdicts = [n["verdict"] for table in paper["tables"] for n in table["numbers"]]
    agrees, differs = verdicts.count("agrees"), verdicts.count("differs")
    count = f"{agrees} of {agrees + differs} printed numbers agree with ours.\n\n"
    rows = [(claim["text"], claim["source"], claim["verdict"]) for claim in paper["claims"]]
    return (
        f"## [{paper['title']}]({paper['paper']}.md)\n\n{paper['citation']}\n\n"
        f"{count if agrees + differs else ''}{table(('claim', 'where', 'verdict'), rows)}"
    )


def _template(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
    )
    filters = {"cite": numbers.cite, "number": numbers.number_text, "percent": numbers.percent}
    environment.filters |= filters
    environment.globals |= {"table": _number_table, "grid": _grid_table}
    return environment.get_template(name)
