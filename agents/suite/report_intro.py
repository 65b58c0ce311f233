"""How to read the report: what was compared, who knew what, on which seeds, and what is proven."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..output.markup import ranged
from .committed import FOLDER
from .found import Found
from .verdict import RATES


def how_to_read(found: Mapping[str, Found]) -> list[str]:
    """The report's first section."""
    first = next(iter(found.values())).baselines
    last = first["seed"] + first["episodes"] - 1
    agents = [front["seeds"] for one in found.values() for front in one.classes.values()]
    tuned = [one.envelopes["inputs"]["tuning"] for one in found.values() if one.envelopes]
    validated = [one.validation for one in found.values() if one.validation]
    seeds = [f"Test: {first['seed']:,} to {last:,}, the same noise for all."]
    if tuned:
        seeds.append(
            f"Tuning: {_of(tuned, 'seeds')} searches of {_of(tuned, 'episodes')} episodes each, "
            f"from {_of(tuned, 'seed')} on."
        )
    if validated:
        seeds.append(
            f"Validation, which chooses the moment of a training that is kept: "
            f"{_of(validated, 'episodes')} episodes from {_of(validated, 'seed')} on."
        )
    number = f"{ranged(agents)} training seeds" if agents else "none so far"
    seeds.append(f"Agents of a class: {number}.")
    text = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    text = text.format(folder=FOLDER, seeds=" ".join(seeds), rates=RATES)
    return text.split("\n")


def _of(every: Sequence[Mapping[str, Any]], key: str) -> str:
    return ranged([one[key] for one in every])
