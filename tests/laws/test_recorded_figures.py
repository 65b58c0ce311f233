"""Figures of every case as they were recorded: a change of structure changes none of them.

    python tests/laws/test_recorded_figures.py     # record them again, after a change that is meant

A figure is the sum of a quantity's entries with random weights. The tolerance is what processors
differ by, relative to the sum of magnitudes.
"""

import json
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from cases import CASES, IDS, SCARCE, VARIANTS, Array, Case, Options, read, requests, short

from fusion_gym.core.memory import Owner
from fusion_gym.errors import ConfigurationError

FILE = Path(__file__).with_name("recorded_figures.json")
RUNS, STEPS, TOLERANCE = 3, 8, 1e-6
SETS, SHARE = 20, 0.35  # drawn sets of options of each environment, and of the options in a set
# Values of the options that every environment has.
DRAWN = {
    "access": ("any", "single", "round_robin", "random"),
    "belief_features": (True, "value"),
    "broadcast": ("estimate", "packets"),
    "clock": (True,),
    "cost_weight": (0.01, 2.0),
    "error": ("trace", "maximum"),
    "information": ("centre",),
    "memory": (True,),
    "packet": ("estimate",),
    "sharing": ("equal", "fixed", "turns"),
    "tokens": ("limited", "unlimited"),
    "true_measurement_noise": (2.0, (0.5, 1.5)),
    "true_process_noise": (0.5, (0.5, 1.5)),
}
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
            beliefs = batch.beliefs()
            add("difference of beliefs", step, beliefs.difference)
            add("value of a transmission", step, beliefs.value)
        result = batch.step(request)
        add("reward", step, result.reward)
        add("squared error", step, result.squared_error)
    return {name: (float(f"{s[0]:.10g}"), float(f"{s[1]:.3g}")) for name, s in sums.items()}


def owners(case: Case) -> list[Owner | None]:
    """The owners of beliefs that a case has, or none."""
    if not case.options.get("memory"):
        return [None]
    return ["scheduler", "own"] if case.local else ["scheduler"]


def drawn_options(env_id: str) -> list[Options]:
    """Sets of options that the environment allows, drawn with a seed."""
    rng, result = np.random.default_rng(zlib.crc32(env_id.encode())), []
    variants = [{}, *VARIANTS.get(short(env_id), []), SCARCE]
    while len(result) < SETS:
        options = dict(variants[rng.integers(len(variants))])
        for name, values in DRAWN.items():
            if rng.random() < SHARE:
                options[name] = values[rng.integers(len(values))]
        try:
            Case(env_id, options).task()
        except ConfigurationError:
            continue
        result.append(options)
    return result


def with_owners(cases: list[Case]) -> list[tuple[Case, Owner | None]]:
    """Each case with each of its owners of beliefs."""
    return [(case, owner) for case in cases for owner in owners(case)]


SHIPPED = [env_id for env_id in IDS if env_id.startswith("fusion_gym/")]
RECORDED = json.loads(FILE.read_text()) if FILE.exists() else {"options": {}, "figures": {}}
DRAWN_CASES = [Case(env_id, o) for env_id in SHIPPED for o in RECORDED["options"].get(env_id, [])]
NAMED_CASES = [case for case in CASES if case.env_id in SHIPPED]


def places(cases: list[Case], mark: str) -> dict[str, tuple[Case, Owner | None]]:
    """The cases by their keys in the file."""
    return {f"{mark}{i} {c} {o}": (c, o) for i, (c, o) in enumerate(with_owners(cases))}


EVERY = places(NAMED_CASES, "") | places(DRAWN_CASES, "drawn ")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("case", "owner"), EVERY.values(), ids=EVERY)
def test_figures_are_the_recorded_ones(
    case: Case, owner: Owner | None, request: pytest.FixtureRequest
) -> None:
    recorded, figures = RECORDED["figures"][request.node.callspec.id], figures_of(case, owner)
    assert figures.keys() == recorded.keys()
    for name, (total, size) in figures.items():
        assert total == pytest.approx(recorded[name][0], rel=0.0, abs=TOLERANCE * size + 1e-12), (
            name
        )


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    options = {env_id: drawn_options(env_id) for env_id in SHIPPED}
    drawn = [Case(env_id, own) for env_id in SHIPPED for own in options[env_id]]
    every = places(NAMED_CASES, "") | places(drawn, "drawn ")
    figures = {key: json.dumps(figures_of(*pair)) for key, pair in every.items()}
    lines = ",\n".join(f"{json.dumps(key)}: {row}" for key, row in figures.items())
    FILE.write_text(f'{{"options": {json.dumps(options)},\n"figures": {{\n{lines}\n}}}}\n')
