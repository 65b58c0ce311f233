"""The quick benchmark's verdicts beside those of the full one."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.table import Table

from ..output.markup import share
from ..output.tables import table_tables
from .tables import read_rows


def agreement_table(quick: Path, full: Path, settings: Sequence[str]) -> Table | None:
    """Each class of agents over the middle of its front: what both say, and whether they agree.

    They agree where their 95 % intervals have a value in common. ``None`` where the folder
    ``full`` has no verdict of any class that the folder ``quick`` has.

    Raises:
        ConfigurationError: a verdict that is damaged.
    """
    rows = []
    for name in settings:
        ours, theirs = _middles(quick / name), _middles(full / name)
        for of, our in ours.items():
            if of in theirs:
                rows.append((name, of, our, theirs[of], _overlap(our, theirs[of])))
    if not rows:
        return None
    agreeing = sum(row[-1] for row in rows)
    return table_tables(
        "agents against the rules of their class: the quick benchmark and the full one",
        ("setting", "class", "quick", "full", "agree"),
        [(*row[:2], share(row[2]), share(row[3]), "yes" if row[4] else "no") for row in rows],
        f"{agreeing} of {len(rows)} verdicts agree: their 95 % intervals overlap",
    )


def _middles(folder: Path) -> dict[str, Mapping[str, float]]:
    """The verdict of every class over the middle of its front."""
    if not (folder / "fronts.csv").exists():
        return {}
    rows = read_rows(folder, "fronts")
    return {row["class"]: row["middle"] for row in rows if "middle" in row}


def _overlap(item: Mapping[str, float], other: Mapping[str, float]) -> bool:
    return item["low"] <= other["high"] and other["low"] <= item["high"]
