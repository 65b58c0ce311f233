"""All perturbed cases of a setting in a line: in how many of them agents are ahead of the rules."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fusion_gym.validation import choice

from ..output.files import read_json
from ..output.markup import NONE, plain_text, share, table_markup
from .reports import VERDICT
from .robustness import NOMINAL

FOLDER = "robustness"  # in that of the results
KINDS = {"agents": "agent_", "trained": "trained_"}  # what their labels begin with
_HEAD = ["setting", "agents", "as assumed", "better", "undecided", "worse", "at worst"]
_NAMES = {"agents": "as they are", "trained": "trained over draws"}
Report = Mapping[str, Any]


def read_reports(results: Path, settings: Sequence[str]) -> list[dict[str, Any]]:
    """What was found in settings, in their order, by class.

    Raises:
        ConfigurationError: a verdict that is damaged.
    """
    folder = results / FOLDER
    paths = [path for name in settings for path in sorted(folder.glob(f"{name}/*/{VERDICT}"))]
    return [read_json(path, "results") for path in paths]


def robustness_summary(reports: Sequence[Report], titles: Mapping[str, str]) -> list[str]:
    """A table: each setting's agents as they are, and those trained over draws.

    ``titles`` of the settings by name; what stands before their first comma is shown.

    Raises:
        ConfigurationError: a setting without a title.
    """
    rows = []
    for report in reports:
        choice("setting", report["setting"], titles)
        title = titles[report["setting"]].partition(",")[0]
        for kind, name in _NAMES.items():
            if kind in report["cases"][NOMINAL]:
                rows.append([plain_text(title), name, *_cells(report["cases"], kind)])
    return table_markup(_HEAD, rows)


def _cells(cases: Mapping[str, Report], kind: str) -> Iterator[str]:
    nominal = cases[NOMINAL][kind].get("middle")
    result = {
        row["title"]: row[kind]["middle"]
        for name, row in cases.items()
        if name != NOMINAL and "middle" in row.get(kind, {})
    }
    better = sum(is_gain(middle) for middle in result.values())
    worse = sum(middle["low"] > 0.0 for middle in result.values())
    yield share(nominal)
    yield from map(str, (better, len(result) - better - worse, worse))
    worst = max(result, key=lambda title: float(result[title]["mean"]), default=None)
    yield NONE if worst is None else f"{share(result[worst])}, {plain_text(worst)}"


def is_gain(middle: Mapping[str, float]) -> bool:
    """Whether the whole interval lies on the side of the agents."""
    return middle["high"] < 0.0
