"""Figures of every case as they were recorded: a change of structure changes none of them.

    python tests/laws/test_recorded_figures.py     # record them again, after a change that is meant

A figure is the sum of a quantity's entries with random weights. The tolerance is what processors
differ by, relative to the sum of magnitudes.
"""

import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from cases import CASES, Array, Case, read, requests

from fusion_gym.core.memory import Owner

FILE = Path(__file__).with_name("recorded_figures.json")
RUNS, STEPS, TOLERANCE = 3, 8, 1e-6
Figures = dict[str, tuple[float, float]]


def figures_of(case: Case, owner: Owner | None) -> Figures:
    """The figure of each quantity over some steps with random requests, and its magnitudes' sum."""
    task, batch = case.task(), case.batch(RUNS, 5, owner)
    sums: dict[str, Array] = {}

    def add(name: str, step: int, value: Array) -> None:
        numbers = np.nan_to_num(
            np.asarray(value, dtype=np.float64).ravel(), posinf=1e3, neginf=-1e3
        )
        seed = zlib.crc32(f"{name} {step}".encode())
        weights = np.random.default_rng(seed).uniform(0.5, 1.5, numbers.size)
        part = np.array([weights @ numbers, weights @ np.abs(numbers)])
        sums[name] = sums.get(name, np.zeros(2)) + part

    for step, request in enumerate(requests(task, RUNS, STEPS)):
        add("observation", step, batch.observe())
        signals = read(batch)
        for name in signals:
            add(name, step, signals[name])
        if owner is not None:
            beliefs = batch.memory.beliefs(batch.state)
            add("difference of beliefs", step, beliefs.difference)
            add("value of a transmission", step, beliefs.value())
        result = batch.step(request)
        add("reward", step, result.reward)
        add("squared error", step, result.squared_error)
    return {name: (float(f"{s[0]:.10g}"), float(f"{s[1]:.3g}")) for name, s in sums.items()}


def owners(case: Case) -> list[Owner | None]:
    """The owners of beliefs that a case has, or none."""
    if not case.options.get("memory"):
        return [None]
    return ["scheduler", "own"] if case.local else ["scheduler"]


SHIPPED = [case for case in CASES if case.env_id.startswith("fusion_gym/")]
EVERY = [(case, owner) for case in SHIPPED for owner in owners(case)]
RECORDED = json.loads(FILE.read_text()) if FILE.exists() else {}


@pytest.mark.parametrize(("case", "owner"), EVERY, ids=lambda item: str(item))
def test_figures_are_the_recorded_ones(case: Case, owner: Owner | None) -> None:
    recorded, figures = RECORDED[f"{case} {owner}"], figures_of(case, owner)
    assert figures.keys() == recorded.keys()
    for name, (total, size) in figures.items():
        assert total == pytest.approx(recorded[name][0], rel=0.0, abs=TOLERANCE * size + 1e-12), (
            name
        )


if __name__ == "__main__":
    text = {f"{case} {owner}": figures_of(case, owner) for case, owner in EVERY}
    FILE.write_text(json.dumps(text, indent=0) + "\n")
