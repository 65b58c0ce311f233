"""A branch of a batch: the step that would have been, apart from the runs that it began as."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.memory import Owner

TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": ("TobitOscillator-v0", {"horizon": 6}),
    "memory": ("TobitOscillator-v0", {"filter": "tobit", "memory": True, "packet": "estimate"}),
    "heard": ("TobitOscillator-v0", {"filter": "tobit", "memory": True, "broadcast": "packets"}),
    "random": ("BiasedTracking-v0", {"access": "random", "memory": True}),
    "correlated": ("CorrelatedTracking-v0", {"memory": True, "noise_scale": "random"}),
    "markov": ("MarkovJumpTracking-v0", {"memory": True, "memory_filter": "imm"}),
    "unknown": ("UnknownInput-v0", {"memory": True, "horizon": 5}),
    "remote": (
        "RemoteEstimation-v0",
        {"sensors": 2, "channel": "gilbert_elliott", "cost_weight": "random",
         "price_range": (0.1, 1.0)},
    ),
}  # fmt: skip
RUNS = 5


def contents(batch: Any) -> list[bytes]:
    """Everything that a batch shows of its runs."""
    shown = [batch.observe(), batch.tokens, batch.price, batch.steps, batch.admitted()]
    shown += [batch.grantable(), batch.beliefs().best.mean, batch.beliefs().value()]
    return [np.ascontiguousarray(part).tobytes() for part in shown]


@pytest.mark.parametrize(
    ("name", "owner"),
    [*((name, "coordinator") for name in TASKS), ("heard", "own"), ("unknown", "own")],
)
def test_a_branch_takes_the_step_that_would_have_been(name: str, owner: Owner) -> None:
    """Also of finished runs, on their continued state; nothing of the real runs moves."""
    env_id, options = TASKS[name]
    task = fusion_gym.make_task(f"fusion_gym/{env_id}", **options)
    batch = EpisodeBatch.seeded(task, RUNS, 3, owner)
    rng = np.random.default_rng(0)
    for _ in range(7):
        requests, other = rng.random((2, task.sensors, RUNS)) < 0.4
        branch, elsewhere, before = batch.branch(), batch.branch(), contents(batch)
        assert contents(branch) == before
        elsewhere.step(other, rng.standard_normal((batch.channels, RUNS)))
        assert contents(elsewhere) != before
        assert contents(batch) == before
        outcome = batch.step(requests)
        after = contents(batch)
        found = branch.step(requests, batch.normals())
        for one, two in zip(found, outcome, strict=True):
            np.testing.assert_array_equal(one, two)
        assert contents(branch) == after == contents(batch)


@pytest.mark.parametrize("owner", ["coordinator", "own"])
def test_runs_are_taken_again_and_again(owner: Owner) -> None:
    """A run on its noise does not depend on which copy it is, or on what stands beside it."""
    task = fusion_gym.make_task("fusion_gym/TobitOscillator-v0", filter="tobit", memory=True)
    batch = EpisodeBatch.seeded(task, RUNS, 3, owner)
    batch.step(np.ones((3, RUNS), dtype=np.bool_))
    branch = batch.branch(np.array([4, 1, 1]))
    assert branch.observe().tobytes() == batch.observe()[[4, 1, 1]].tobytes()
    again, noise = branch.branch(np.array([2, 0])), np.random.default_rng(0)
    row = noise.standard_normal((branch.channels, 3))
    requests = np.array([[True, False, True]] * 3)
    branch.step(requests, row)
    again.step(requests[:, [2, 0]], row[:, [2, 0]])
    assert again.observe().tobytes() == branch.observe()[[2, 0]].tobytes()
    assert not np.array_equal(branch.observe()[1], branch.observe()[2])
