"""Drawn sets of options with memory: the compiled backend gives the steps of NumPy."""

import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from cases import SCARCE, VARIANTS, Options

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import present_id

RUNS, STEPS, SETS = 3, 300, 2
VALUES: dict[str, tuple[Any, ...]] = {
    "access": ("any", "single", "round_robin", "random"),
    "acknowledgements": ("none", 0.5),
    "belief_features": (True, "value"),
    "broadcast": ("estimate", "packets"),
    "channel": ("independent", "gilbert_elliott"),
    "clock": (True,),
    "cost_weight": (0.01, 2.0),
    "error": ("trace", "maximum"),
    "sharing": ("equal", "fixed", "turns"),
    "tokens": ("limited", "unlimited"),
}
NAMES = "CorrelatedTracking", "MarkovJumpTracking", "UnknownInput", "BiasedOscillator"


def drawn(name: str) -> Iterator[tuple[Options, list[EpisodeBatch]]]:
    """Options that the environment takes and that are compiled, with a batch of each backend."""
    rng, count = np.random.default_rng(zlib.crc32(name.encode())), 0
    variants = [{}, *VARIANTS[name], SCARCE]
    while count < SETS:
        options = variants[rng.integers(len(variants))] | {"memory": True, "horizon": 40}
        for option, values in VALUES.items():
            if rng.random() < 0.3:
                options[option] = values[rng.integers(len(values))]
        try:
            tasks = [
                fusion_gym.make_task(present_id(name), backend=backend, **options)
                for backend in ("numpy", "compiled")
            ]
        except fusion_gym.ConfigurationError:
            continue
        yield options, [EpisodeBatch.seeded(task, RUNS, 0) for task in tasks]
        count += 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", [*NAMES, "BiasedTracking"])
def test_drawn_options_give_the_steps_of_numpy(name: str) -> None:
    for options, batches in drawn(name):
        rng, single = np.random.default_rng(1), batches[0].task.options.access == "single"
        for step in range(STEPS):
            requests = rng.random((batches[0].task.sensors, RUNS)) < 0.4
            requests &= requests.cumsum(0) == 1 if single else True
            outcomes = [batch.step(requests) for batch in batches]
            label = f"{options} in step {step}"
            for field, ours, plain in zip(outcomes[0]._fields, *outcomes[::-1], strict=True):
                message = f"{field} with {label}"
                assert (ours is None) == (plain is None), message
                if plain is None:
                    continue
                np.testing.assert_allclose(ours, plain, rtol=1e-8, atol=1e-8, err_msg=message)
            if len(ended := np.flatnonzero(outcomes[0].ended)):
                for batch in batches:
                    batch.reset(ended)
            pair = [batch.observe() for batch in batches[::-1]]
            np.testing.assert_allclose(*pair, rtol=1e-4, atol=1e-4, err_msg=label)
