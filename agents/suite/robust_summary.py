"""The tables of the perturbed cases of a setting, written and read."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .tables import grouped, read_rows, write_rows

FOLDER = "robustness"  # of the page for readers in that of the results, and a table's name
KINDS = {"agents": "agent_", "trained": "trained_"}  # what their labels begin with
Report = Mapping[str, Any]


def write_cases(folder: Path, report: Report) -> None:
    """Write what was found of a class into the tables of its setting, beside the other classes."""
    own, points = [], []
    for case, row in report["cases"].items():
        of = {"class": report["class"], "case": case}
        whole = {key: report[key] for key in ("episodes", "sha256")} | dict(row) | of
        kinds = [kind for kind in KINDS if kind in row]
        own += [{**whole, **row[kind], "kind": kind} for kind in kinds] or [whole]
        points += [{**of, "kind": kind} | point for kind in kinds for point in row[kind]["points"]]
    for table, rows in (("robustness_points", points), (FOLDER, own)):
        there = read_rows(folder, table) if (folder / f"{table}.csv").exists() else []
        others = [row for row in there if row["class"] != report["class"]]
        write_rows(folder, table, [*others, *rows])


def read_reports(results: Path, settings: Sequence[str]) -> list[dict[str, Any]]:
    """What was found in settings, in their order, by class.

    Raises:
        ConfigurationError: a table that cannot be read or is of another shape.
    """
    result = []
    for name in settings:
        folder = results / name
        rows = read_rows(folder, FOLDER) if (folder / f"{FOLDER}.csv").exists() else []
        for of, own in sorted(grouped(rows, "class").items()):
            cases: dict[str, Any] = {}
            for row in own:
                case = cases.setdefault(
                    row["case"],
                    {key: row[key] for key in ("title", "always", "rules") if key in row},
                )
                if "kind" in row:
                    case[row["kind"]] = row
            report = {key: own[0][key] for key in ("episodes", "sha256")}
            result.append({"setting": name, "class": of, "cases": cases} | report)
    return result


def is_gain(middle: Mapping[str, float]) -> bool:
    """Whether the whole interval lies on the side of the agents."""
    return middle["high"] < 0.0
