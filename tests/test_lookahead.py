"""The model-based lookahead: against its own arithmetic, its limits, and what it may not see."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from parts import Parts

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.lookahead import Lookahead
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

REMOTE = "fusion_gym/RemoteEstimation-v1"
TOBIT = "fusion_gym/TobitOscillator-v1"
TRACKING = "fusion_gym/BiasedTracking-v1"


def played(task: Task, runs: int = 30, steps: int = 5) -> EpisodeBatch:
    batch = EpisodeBatch.seeded(task, runs, 0)
    generator = np.random.default_rng(1)
    for _ in range(steps):
        batch.step(generator.random((task.sensors, runs)) < 0.3)
    return batch


def test_its_choice_is_the_cheapest_of_all_sets() -> None:
    """A linear target: the distance to the best estimate moves with the transition matrix."""
    options: dict[str, Any] = {"filter": "kalman", "access": "any", "tokens": "unlimited"}
    task = fusion_gym.make_task(TRACKING, token_cost=(3.0, 5.0), **options)
    batch, price, steps = played(task), 0.002, 4
    selected = Lookahead(task, price, steps)(batch.signals())
    parts, weights = Parts.of(task), task.reward.state_weights[:, 0]
    transition = task.plant.dynamics.transition[..., 0]  # type: ignore[attr-defined]
    best, _ = parts.fused(parts.deliver(batch.state, np.ones((2, 30), dtype=np.bool_)))
    for run in range(30):
        costs = {}
        for pattern in product((False, True), repeat=2):
            granted = np.zeros((2, 30), dtype=np.bool_)
            granted[:, run] = pattern
            mean, _ = parts.fused(parts.deliver(batch.state, granted))
            distance = mean[:, run] - best[:, run]
            total = price * (3.0 * pattern[0] + 5.0 * pattern[1])
            for _ in range(steps):
                total += weights @ distance**2
                distance = transition @ distance
            costs[pattern] = total
        assert tuple(selected[:, run]) == min(costs, key=lambda key: costs[key])


@pytest.mark.parametrize("access", ["any", "single"])
def test_losses_are_weighed_by_their_probabilities(access: str) -> None:
    options: dict[str, Any] = {
        "sensors": 3, "noise_deviation": (1.0, 1.5, 0.7), "channel": "gilbert_elliott",
        "drop_probability": (0.9, 0.2), "access": access,
    }  # fmt: skip
    task = fusion_gym.make_task(REMOTE, **options)
    batch, price, runs = played(task), 1.2, 30
    state, channel = batch.state, task.network.channel
    assert channel is not None
    error = (state.plant.truth - state.estimate.prior) ** 2 * task.reward.state_weights
    loss = channel.transition @ channel.drop
    arrives = 1.0 - loss[state.network.channel, np.arange(3)[:, None]]
    policy = Lookahead(task, price, steps=1)
    requests = policy(batch.signals())
    every = [p for p in product((0, 1), repeat=3) if access == "any" or sum(p) <= 1]
    for run in range(runs):

        def expected(sent: tuple[int, ...], run: int = run) -> float:
            total = price * sum(sent)
            for arrived in product(*[(0, 1) if item else (0,) for item in sent]):
                chance = 1.0
                for i in range(3):
                    p = arrives[i, run] if sent[i] else 0.0
                    chance *= p if arrived[i] else 1.0 - p
                total += chance * sum(error[i, run] for i in range(3) if not arrived[i])
            return total

        assert tuple(requests[:, run].astype(int)) == min(every, key=expected)
    assert 0.1 < requests.mean() < 0.9 if access == "any" else requests.sum(0).max() == 1


def test_it_weighs_errors_as_the_reward_does() -> None:
    """Ten times the weight at ten times the price is the same question."""
    answers = [
        Lookahead(task, 0.003 * weight)(played(task).signals())
        for weight in (1.0, 10.0)
        for task in [fusion_gym.make_task(TOBIT, filter="tobit", error_weight=weight)]
    ]
    np.testing.assert_array_equal(*answers)
    assert 0.0 < answers[0].mean() < 1.0


def test_its_limits() -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", tokens="unlimited")
    assert run_episodes(task, Lookahead(task, price=1e9), 5, seed=0).rate.max() == 0.0
    free = run_episodes(task, Lookahead(task, price=0.0), 5, seed=0)
    always = run_episodes(task, make_policy("always", task), 5, seed=0)
    np.testing.assert_allclose(free.mse, always.mse, rtol=1e-9)


def test_it_asks_only_for_what_the_network_grants() -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", token_rate=1.0, sharing="fixed")
    results = run_episodes(task, Lookahead(task, price=1e-4), 20, seed=0)
    assert results.rate.mean() > 0.05
    assert results.denied.max() == 0.0
    single = fusion_gym.make_task(TOBIT, filter="tobit", access="single")
    assert Lookahead(single, price=0.0)(played(single).signals()).sum(0).max() == 1


def test_what_cannot_be_is_refused() -> None:
    centre = fusion_gym.make_task(TOBIT, information="centre")
    with pytest.raises(ConfigurationError, match="information = 'centre'"):
        make_policy("lookahead", centre)
    with pytest.raises(LookupError, match="'estimate'"):
        played(centre).signals()["estimate"]


def test_a_packet_with_an_estimate_leaves_nothing_to_a_second_one() -> None:
    """Any packet brings x*, so one is enough; it goes where the distance outweighs the price."""
    options: dict[str, Any] = {"filter": "kalman", "access": "any", "tokens": "unlimited"}
    task = fusion_gym.make_task(TRACKING, **options, memory=True, packet="estimate")
    batch, price, steps = played(task), 0.01, 3
    requests = Lookahead(task, price, steps)(batch.signals())
    assert set(requests.sum(0)) == {0, 1}
    transition = task.plant.dynamics.transition[..., 0]  # type: ignore[attr-defined]
    distance, total = batch.beliefs().difference[0], np.zeros(30)
    for _ in range(steps):
        total += (task.reward.state_weights * distance**2).sum(0)
        distance = transition @ distance
    np.testing.assert_array_equal(requests.any(0), total > price * task.network.bucket.cost[0, 0])


@pytest.mark.parametrize(
    ("env_id", "options", "price"),
    [
        (REMOTE, {"sensors": 5, "channel": "independent", "drop_probability": 0.3}, 0.3),
        (
            TOBIT,
            {"filter": "kalman", "measurement_matrices": [np.eye(2).tolist()] * 5, "memory": True},
            0.002,
        ),
    ],
)
def test_adding_one_after_another_is_nearly_as_good(
    env_id: str, options: dict[str, Any], price: float
) -> None:
    """Where sensors do not overlap, and losses are theirs alone, it is the same."""
    task = fusion_gym.make_task(env_id, **options, token_capacity=30.0, horizon=30)
    whole, greedy = Lookahead(task, price, 2), Lookahead(task, price, 2)
    assert not whole.greedy
    greedy.greedy = True
    signals = played(task, runs=200).signals()
    same = (whole(signals) == greedy(signals)).all(0)
    several = whole(signals).sum(0) > 1
    assert several.any()
    assert same.mean() > (0.999 if env_id == REMOTE else 0.8)
    best, result = (run_episodes(task, policy, 40, seed=0) for policy in (whole, greedy))
    cost = [price * r.tokens * task.horizon + task.error_scale * r.mse * 30 for r in (best, result)]
    assert abs(cost[1].mean() / cost[0].mean() - 1.0) < 0.02


def test_above_eight_sensors_it_says_that_it_is_greedy() -> None:
    message = "'lookahead' adds one transmission after another for 9 sensors: .* at most 8"
    task = fusion_gym.make_task(REMOTE, sensors=9, cost_weight=0.3, token_capacity=30.0, horizon=5)
    with pytest.warns(UserWarning, match=message) as caught:
        policy: Any = make_policy("lookahead:price=0.3", task)
    assert len(caught) == 1
    assert policy.greedy
    assert run_episodes(task, policy, 4, seed=0).rate.mean() > 0.05
    make_policy("lookahead", fusion_gym.make_task(REMOTE, sensors=13, access="single", horizon=2))
    make_policy("lookahead", fusion_gym.make_task(REMOTE, sensors=8, horizon=2))
