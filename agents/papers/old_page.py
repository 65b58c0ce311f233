"""The pages of a reproduction: Markdown and JSON of a paper, its pictures, and the overview."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2

from agents.papers import claims as claims_module
from agents.papers import numbers
from agents.papers.paper import Data, Paper
from fusion_gym.entries import Plain

TEMPLATES = Path(__file__).parent
Counts = Mapping[str, Mapping[str, int]]  # episodes and seed of each piece
Results = Mapping[str, Mapping[str, Data]]  # of the pieces, by reading


def render_old_page(paper: Paper, results: Results, counts: Counts) -> tuple[str, Plain]:
    """Return a paper's Markdown from the data of all its pieces, and its numbers as plain JSON."""
    outcomes: dict[str, dict[str, float]] = {}  # by claim and reading
    claims: list[dict[str, str]] = []
    reading, every = "", dict[str, dict[str, Data]]()

    def claim(text: str, source: str, parts: Any, caller: Callable[[], str]) -> str:
        text, source = _line(text), _line(source)
        result, own = parts, outcomes.setdefault(f"{source}: {text}", {})
        if not isinstance(parts, str):
            cases = parts if isinstance(parts, Mapping) else {"": parts}
            for case, conditions in cases.items():
                key = f"{reading}: {case}" if case else reading
                own[key] = claims_module.outcome(conditions)
            result = claims_module.verdict(own.values())
        names = [name.rpartition(": ")[2] for name, value in own.items() if value == 1.0]
        ways = ", ".join(dict.fromkeys(names))
        region = f": holds with {ways}" if result == claims_module.DEPENDS else ""
        row = {"text": text, "source": source, "verdict": result, "evidence": _line(caller())}
        claims.append(row)
        cells = row | {"verdict": f"**{result}**{region}"}
        return f"| {' | '.join(map(_cell, cells.values()))} |\n"

    def tally() -> list[tuple[str, int]]:
        """Return the number of claims that hold under each reading."""
        judged = [own for own in outcomes.values() if set(own) == set(results)]
        return [(name, sum(own[name] == 1.0 for own in judged)) for name in results]

    template = _template(f"{paper.name}.md")
    for reading in [*results][::-1]:  # the environment's is the last, and the page's
        claims.clear()
        every[reading] = pieces = {
            piece.name: results[reading][piece.name] | piece.summarise(results[reading][piece.name])
            for piece in paper.pieces
        }
        text = template.render(
            pieces, paper=paper.name, claim=claim, counts=counts, tally=tally, every=every,
            misprint=claims_module.MISPRINT,
        )  # fmt: skip
    lines = text.splitlines()
    tables = [
        {
            "piece": name,
            "name": table,
            "numbers": [n._asdict() | {"verdict": n.verdict} for n in entries],
        }
        for name, piece in pieces.items()
        for table, entries in piece.get("tables", {}).items()
    ]
    return text, {
        "paper": paper.name,
        "title": lines[0].removeprefix("# "),
        "citation": lines[2],
        "made": {name: dict(count) for name, count in counts.items()},
        "tables": tables,
        "claims": claims,
    }


def _template(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "cell": _cell, "cite": numbers.cite, "line": _line, "number": numbers.number_text,
        "percent": numbers.percent,
    }  # fmt: skip
    functions = numbers.always, numbers.below, numbers.by_mean, numbers.estimate
    environment.globals |= {function.__name__: function for function in functions}
    return environment.get_template(name)


def _line(text: str) -> str:
    return " ".join(text.split())


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
