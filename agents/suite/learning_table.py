"""Tables of how fast agents learn, for the terminal and in Markdown."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from ..output.markup import share
from .study import SOLVED

Report = Mapping[str, Any]
_LABELS = {"front": "with credit and memory", "plain": "plain PPO"}
_COLUMNS = (
    "setting", "steps/s", "with values", "below the rules without memory",
    "plain PPO", "finished against", "above", "worst", "gap closed",
)  # fmt: skip
_FIRSTS = (
    "training", "seed", "below after", "seconds", "there by", "over the rates",
    "later measurements not below", "ended after", "seconds",
)  # fmt: skip


def overview(reports: Sequence[Report]) -> Table:
    """One row a setting."""
    table = Table(title="what agents learn, and how fast", box=box.SIMPLE_HEAD, show_lines=True)
    for column in _COLUMNS:
        table.add_column(column, overflow="fold", no_wrap=column == "setting")
    for report in reports:
        table.add_row(*row(report))
    return table


def row(report: Report) -> list[str]:
    """A setting's cells."""
    speed, course = report["throughput"] or {}, report["course"]
    steps = [f"{speed[name]:,.0f}" if name in speed else "–" for name in ("without", "values")]
    remembering = course["memoryless"] is not None
    moments = [_moments(report["reached"][kind]) for kind in ("front", "plain")]
    result = report["finished"]
    cells = ["–", "–", "–"]
    if result:
        worst = result["worst"]
        low, high = result["rates"]
        cells = [
            f"{len(result['above'])} of {result['compared']} above {course['allowed']:+.1%} "
            f"(rates {low:.3f} to {high:.3f})",
            f"{share(worst['difference'])} (seed {worst['seed']}, price {worst['price']:.3g})",
            ", ".join(
                f"{part:.0%} to {name}"
                for name, part in result["closed"].items()
                if part is not None
            )
            or "–",
        ]
    moments = moments if remembering else ["–", "–"]
    return [report["setting"], *steps, *moments, course["against"], *cells]


def _moments(reached: Sequence[Mapping[str, Any]]) -> str:
    """When the seeds' fronts first were below the envelope."""
    if not reached:
        return "–"
    firsts = [item["first"] for item in reached if "first" in item]
    parts = [f"{len(firsts)} of {len(reached)} seeds"]
    if firsts:
        parts += [
            _span("{:.0f} s", firsts, "cpu_seconds"),
            _span("{:,} steps", firsts, "timesteps"),
        ]
    if len(firsts) < len(reached):
        late = [item for item in reached if "first" not in item]
        parts.append(f"not within {min(item['cpu_seconds'] for item in late):.0f} s")
    return ", ".join(parts)


def _span(form: str, rows: Sequence[Mapping[str, Any]], name: str) -> str:
    low, high = (choose(item[name] for item in rows) for choose in (min, max))
    texts = dict.fromkeys((form.format(low), form.format(high)))
    return " to ".join(texts)


def learning_text(reports: Sequence[Report], command: str) -> str:
    """All tables in Markdown, with how they are made."""
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    lines = [
        *text.format(command=command).splitlines(),
        _joined(_COLUMNS),
        _joined(["---"] * len(_COLUMNS)),
        *(_joined(row(report)) for report in reports),
        "",
    ]
    for report in reports:
        lines += details(report)
    return "\n".join(lines)


def _joined(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def details(report: Report) -> Iterator[str]:
    """A setting's seeds, learning curves and finished points."""
    yield f"## {report['title']}"
    yield ""
    if report["course"]["memoryless"] is not None:
        yield from _firsts(report)
        yield from _curves(report)
    solved = report["course"]["against"] in SOLVED
    names = ["cost", "optimum"] if solved else ["mse", "envelope"]
    yield _joined(["price", "rate", *names, "difference, mean of seeds", "worst seed", "above"])
    yield _joined(["---"] * (4 + len(names) + 1))
    allowed = report["course"]["allowed"]
    for place, price in enumerate(report["prices"]):
        points = [front["points"][place] for front in report["fronts"]]
        points = [point for point in points if "difference" in point]
        if not points:
            continue
        worst = max((p["difference"] for p in points), key=lambda d: float(d["mean"]))
        above = sum(p["difference"]["low"] > allowed for p in points)
        mean = float(np.mean([p["difference"]["mean"] for p in points]))
        cells = [f"{np.mean([p[name] for p in points]):.4g}" for name in ("rate", *names)]
        inner = "" if report["inner"][place] else " (outer)"
        cells = [f"{price:.3g}{inner}", *cells, f"{mean:+.1%}", share(worst)]
        yield _joined([*cells, f"{above} of {len(points)}"])
    yield ""


def _firsts(report: Report) -> Iterator[str]:
    """When each seed's front first was below the rules without memory, and over which rates."""
    yield _joined(_FIRSTS)
    yield _joined(["---"] * len(_FIRSTS))
    for kind, seeds in report["reached"].items():
        for seed in seeds:
            cells, first = ["–"] * 5, seed.get("first")
            if first:
                low, high = first["rates"]
                cells = [f"{first['timesteps']:,}", f"{first['cpu_seconds']:.1f}"]
                cells += [f"{first['excess']:+.0%}", f"{low:.3f} to {high:.3f}"]
                cells.append(str(first["above_later"]))
            ended = [f"{seed['timesteps']:,}", f"{seed['cpu_seconds']:.1f}"]
            yield _joined([_LABELS[kind], str(seed["seed"]), *cells, *ended])
    yield ""


def _curves(report: Report) -> Iterator[str]:
    """The most by which the fronts are above the rules without memory, over steps."""
    yield _joined(["training", "steps", "seconds", "above the rules without memory by at most"])
    yield _joined(["---"] * 4)
    for kind, label in _LABELS.items():
        curves = [item["curve"] for item in report["fronts" if kind == "front" else "plain"]]
        for steps in sorted({point["timesteps"] for curve in curves for point in curve}):
            points = [p for curve in curves for p in curve if p["timesteps"] == steps]
            known = [p["excess"] for p in points if p["excess"] is not None]
            ends = dict.fromkeys(f"{end:+.0%}" for end in (min(known), max(known))) if known else {}
            seconds = np.mean([p["cpu_seconds"] for p in points])
            yield _joined([label, f"{steps:,}", f"{seconds:.1f}", " to ".join(ends) or "–"])
    yield ""
