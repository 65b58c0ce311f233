"""The table of the committed envelopes: what the strongest rules do, before agents exist."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fusion_gym.evaluation.envelope import EnvelopePoint, height

from .committed import read_envelopes
from .tables import read_rows

SHARES = (0.05, 0.1, 0.2, 0.4)  # of the rate that transmitting always gets
HEADLINE = 0.2


def envelope_text(results: Path, command: str) -> str:
    """The table in Markdown.

    Raises:
        ConfigurationError: a file that is damaged or of another shape.
    """
    files = sorted(results.glob("*/classes.csv"))
    content = [read_envelopes(path.parent) for path in files]
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    lines = text.format(command=command).splitlines()
    for envelopes in content:
        lines += rows_of(envelopes, results)
    lines += ["", "## The strongest rules", ""]
    for envelopes in content:
        lines += vertices_of(envelopes)
    return "\n".join(lines) + "\n"


def rows_of(envelopes: dict[str, Any], results: Path) -> Iterator[str]:
    """A setting's rows; simulated were packets with a measurement, the bound holds for any."""
    name = envelopes["setting"]
    rates = [round(share * envelopes["always"], 4) for share in SHARES]
    rollout, episodes = measured(results / name)
    bound = bound_of(results / name)
    grouped: dict[str, dict[bool, list[EnvelopePoint]]] = {}
    for content in envelopes["classes"].values():
        grouped.setdefault(_label(content), {})[content["memory"]] = hull_of(content)
    for label, hulls in sorted(grouped.items()):
        for rate in rates:
            cells = [cell(hulls.get(memory, []), rate) for memory in (False, True)]
            cells.append(cell(rollout if label == "sensors" else [], rate))
            cells[-1] += f" ({episodes})" if cells[-1] != "–" else ""
            cells.append("–" if bound is None else f"{at_least(bound, rate):.4g}")
            yield f"| {name} | {label} | {rate:.4g} | {' | '.join(cells)} |"


def _label(content: dict[str, Any]) -> str:
    """A class without its memory."""
    held = "packets that hold the estimate" * (content["options"].get("packet") == "estimate")
    return ", ".join(part for part in (content["mode"], content["broadcast"], held) if part)


def hull_of(content: dict[str, Any]) -> list[EnvelopePoint]:
    """A class's envelope on the test seeds."""
    points = [
        EnvelopePoint(v["name"], v["test"]["rate"], v["test"]["mse"]["mean"])
        for v in content["vertices"]
    ]
    return sorted(points, key=lambda point: (point.rate, point.mse))


def measured(folder: Path) -> tuple[list[EnvelopePoint], int]:
    """The rollout of a setting's folder, if it was run, and its number of episodes.

    Raises:
        ConfigurationError: the table is of another shape.
    """
    if not (folder / "rollout.csv").exists():
        return [], 0
    rows = read_rows(folder, "rollout")
    points = [EnvelopePoint(f"{row['rate']}", row["rate"], row["mse"]["mean"]) for row in rows]
    return sorted(points, key=lambda point: point.rate), rows[0]["episodes"]


def bound_of(folder: Path) -> dict[str, Any] | None:
    """The lower bound of a setting's folder, if it was computed.

    Raises:
        ConfigurationError: the table is of another shape.
    """
    if not (folder / "bounds.csv").exists():
        return None
    rows = read_rows(folder, "bounds")
    return {"sensors": rows[0]["sensors"], "floor": rows[0]["floor"], "costs": rows}


def at_least(bound: dict[str, Any], rate: float) -> float:
    """The least error at a rate that the prices' lines leave: between two rates a bound as well."""
    packets = bound["sensors"] * rate
    lines = [cost["lower"] - cost["price"] * packets for cost in bound["costs"]]
    return float(max([bound["floor"], *lines]))


def cell(points: list[EnvelopePoint], rate: float) -> str:
    """The error at a rate between the points, or a dash."""
    computed = bool(points) and points[0].rate > 0.0  # point by point: it ends with the last one
    if not points or (computed and rate > points[-1].rate):
        return "–"
    result = height(points, rate)
    return "–" if result is None else f"{result:.4g}"


def vertices_of(envelopes: dict[str, Any]) -> Iterator[str]:
    """A setting's schedulers and what their envelopes are made of."""
    yield f"### {envelopes['title']}"
    yield ""
    yield "| class | rule | rate | MSE on test seeds | on tuning seeds |"
    yield "|---|---|---|---|---|"
    for name, content in envelopes["classes"].items():
        for vertex in content["vertices"]:
            test, tuning = vertex["test"], vertex["tuning"]
            yield (
                f"| {name} | `{vertex['name']}` | {test['rate']:.4f} | "
                f"{test['mse']['mean']:.4g} [{test['mse']['low']:.4g}, {test['mse']['high']:.4g}] "
                f"| {tuning['mse']['mean']:.4g} |"
            )
    yield ""
