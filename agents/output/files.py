"""Results on disk: JSON for readers, and episodes for a verdict."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fusion_gym.evaluation.episodes import EpisodeResults

FIELDS = tuple(EpisodeResults.__dataclass_fields__)


def write(path: Path | None, report: Mapping[str, Any]) -> None:
    """Replace a JSON file, if one is wanted, in one move: an interrupt never leaves half of it."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".part")
    partial.write_text(json.dumps(report, indent=1) + "\n")
    partial.replace(path)


def save_results(path: Path, results: Mapping[str, EpisodeResults]) -> None:
    """All results in one compressed file, written in one move."""
    arrays = {
        f"{place}/{field}": getattr(found, field)
        for place, found in enumerate(results.values())
        for field in FIELDS
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.stem + ".part.npz")
    np.savez_compressed(partial, names=np.array(list(results), dtype=np.str_), **arrays)
    partial.replace(path)


def load_results(path: Path) -> dict[str, EpisodeResults]:
    """What :func:`save_results` wrote."""
    with np.load(path, allow_pickle=False) as arrays:
        return {
            str(name): EpisodeResults(**{field: arrays[f"{place}/{field}"] for field in FIELDS})
            for place, name in enumerate(arrays["names"])
        }
