"""One improvement by simulation: it beats its base, and is blind to what is hidden."""

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies import rollout
from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

REMOTE, TRACKING = "fusion_gym/RemoteEstimation-v1", "fusion_gym/BiasedTracking-v1"
TOBIT, MARKOV = "fusion_gym/TobitOscillator-v1", "fusion_gym/MarkovJumpTracking-v1"
CORRELATED, INPUT = "fusion_gym/CorrelatedTracking-v1", "fusion_gym/UnknownInput-v1"
VALUE = "value_of_information:threshold=0.05,at_most=1"
CASES: dict[str, tuple[str, dict[str, Any], str]] = {
    "tobit": (TOBIT, {"filter": "tobit", "memory": True, "packet": "estimate"}, VALUE),
    "tobit, no memory": (TOBIT, {"access": "random"}, VALUE),
    "correlated": (CORRELATED, {"memory": True, "noise_scale": "random"}, VALUE),
    "markov": (MARKOV, {"memory": True, "memory_filter": "imm"}, VALUE),
    "unknown input": (INPUT, {"memory": True}, VALUE),
    "unknown steps": (INPUT, {"input_signal": "steps"}, "innovation_threshold:threshold=2"),
    "remote": (
        REMOTE,
        {"sensors": 2, "channel": "gilbert_elliott", "cost_weight": 1.0},
        "innovation_threshold:threshold=1.5",
    ),
}


def case(name: str, samples: int = 3, steps: int = 2) -> tuple[Task, Policy]:
    env_id, options, base = CASES[name]
    task = fusion_gym.make_task(env_id, **options)
    return task, make_policy(f"rollout:samples={samples},steps={steps},base={base}", task)


def test_runs_and_seeds_are_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reset begins again; a run does not depend on those beside it, nor on how they are cut."""
    env_id, options, base = CASES["tobit"]
    task = fusion_gym.make_task(env_id, **options, horizon=12)
    policy = make_policy(f"rollout:samples=3,steps=2,base={base}", task)
    results = run_episodes(task, policy, 4, seed=5)
    again = run_episodes(task, policy, 4, seed=5)
    np.testing.assert_array_equal(results.returns, again.returns)
    single = run_episodes(task, policy, 1, seed=7)
    np.testing.assert_array_equal(results.returns[2], single.returns[0])
    monkeypatch.setattr(rollout, "_LANES", 24)
    cut = run_episodes(task, policy, 4, seed=5)
    np.testing.assert_array_equal(results.returns, cut.returns)
    batch = EpisodeBatch.seeded(task, 40, 0)
    batch.step(np.zeros((3, 40), dtype=np.bool_))
    answers = []
    for seed in (0, 1):
        policy.reset(40, seed)
        answers.append(policy(batch.signals()))
    assert not np.array_equal(*answers)


def test_it_asks_for_what_is_worth_its_price() -> None:
    """Sources that nobody else serves: a packet takes w e² (1 + a² + …) off, in expectation."""
    task = fusion_gym.make_task(REMOTE, sensors=2, coefficient=0.8, tokens="unlimited")
    batch, price, steps = EpisodeBatch.seeded(task, 80, 0), 1.0, 3
    for _ in range(3):
        batch.step(np.zeros((2, 80), dtype=np.bool_))
    text = f"rollout:samples=400,steps={steps},price={price},doubt=0,base=never"
    policy = make_policy(text, task)
    policy.reset(80)
    requests = policy(batch.signals())
    error = (batch.state.plant.truth - batch.state.estimate.prior) ** 2 * task.reward.state_weights
    worth = error * sum(0.8 ** (2 * step) for step in range(steps + 1)) - price
    best = np.where(worth.max(0) > 0.0, worth.argmax(0), -1)
    clear = (np.abs(worth) > 0.3).all(0) & (np.abs(worth[0] - worth[1]) > 0.3)
    expected = np.arange(2)[:, None] == best
    assert clear.sum() > 20
    assert 0 < expected[:, clear].sum() < clear.sum()
    np.testing.assert_array_equal(requests[:, clear], expected[:, clear])


@pytest.mark.parametrize(
    ("env_id", "options", "base", "gain"),
    [
        (TOBIT, {"filter": "tobit", "token_rate": 2.0, "memory": True}, VALUE, 0.0),
        (TRACKING, {"access": "any", "cost_weight": 0.1}, "paced:rate=0.2", 1.0),
        (
            REMOTE,
            {"sensors": 2, "cost_weight": 1.0, "channel": "independent", "drop_probability": 0.3},
            "innovation_threshold:threshold=1",
            0.0,
        ),
    ],
)
def test_it_costs_no_more_than_its_base(
    env_id: str, options: dict[str, Any], base: str, gain: float
) -> None:
    task = fusion_gym.make_task(env_id, **({"cost_weight": 0.03} | options), horizon=40)
    policy = make_policy(f"rollout:samples=16,steps=5,base={base}", task)
    results = run_episodes(task, policy, 24, seed=0).returns
    plain = run_episodes(task, make_policy(base, task), 24, seed=0).returns
    better = results - plain
    assert better.mean() > gain - 2.0 * better.std() / np.sqrt(24)


def test_only_the_ratio_of_price_and_error_weight_counts() -> None:
    requested = []
    for weight, price in ((1.0, 0.1), (10.0, 1.0)):
        task = fusion_gym.make_task(REMOTE, sensors=2, error_weight=weight, cost_weight=price)
        batch = EpisodeBatch.seeded(task, 30, 0)
        requested.append(make_policy("rollout:samples=4,steps=2,base=never", task)(batch.signals()))
    np.testing.assert_array_equal(*requested)
    assert requested[0].any(0).sum() > 5


@pytest.mark.parametrize("name", CASES)
def test_what_is_imagined_follows_what_is_believed(name: str) -> None:
    """Moments of the truth over many draws; memory and centre have the same measurements."""
    task, policy = case(name)
    batch: Any = EpisodeBatch.seeded(task, 2, 0)
    for _ in range(4):
        batch.step(np.zeros((task.sensors, 2), dtype=np.bool_))
    signals, count = batch.signals(), 4000
    imagination = policy._imagination  # type: ignore[attr-defined]
    runs = np.repeat([0, 1], count)
    normals = np.random.default_rng(0).standard_normal((imagination.channels(1), 2 * count))
    imagined, noise = imagination.begin(signals, runs, normals)
    state, best = imagined.state, signals["beliefs"].best  # type: ignore[attr-defined]
    truth = task.plant.truth(state.plant).reshape(-1, 2, count)
    deviation = np.sqrt(np.einsum("iin->in", best.covariance[0]))
    if not name.startswith("unknown"):  # their input has a law of its own
        assert (np.abs(truth.mean(-1) - best.mean[0]) < 0.1 * deviation + 1e-12).all()
        least = 0.6 if name == "correlated" else 0.9  # the covariance is a bound
        if name != "remote":
            ratio = truth.std(-1) / deviation
            assert (ratio > least).all()
            assert (ratio < 1.1).all()
    else:
        plant, drawn = task.plant, state.plant  # type: ignore[attr-defined]
        last = plant.signal.value(drawn.signal, drawn.time - 1.0)
        mask = np.isclose(last, task.plant.truth(state.plant)[-1:])
        assert mask.mean() > (0.99 if name == "unknown input" else 0.9)  # steps may have jumped
        apart = np.abs(truth.mean(-1) - best.mean[0]) / deviation
        assert (apart < 1.0).all()
    if name == "remote":
        arrives = task.network.link_probability(state.network)[:, 0]
        lost = state.network.draws.lost.reshape(-1, 2, count).mean(-1)
        np.testing.assert_allclose(1.0 - lost, arrives[:, [0, count]], atol=0.03)
    if task.memory_estimator is not None:
        ours = imagined.memory.states["every"].measurement
        taken = np.isfinite(ours) & np.isfinite(state.estimate.measurement)
        assert taken.any()
        np.testing.assert_array_equal(ours[taken], state.estimate.measurement[taken])
    assert noise.shape == (1, batch.channels, 2 * count)


def test_the_base_is_the_rest_of_the_text() -> None:
    task = fusion_gym.make_task(TOBIT, filter="tobit", memory=True, cost_weight=0.2)
    policy: Any = make_policy(
        "rollout:samples=2, steps=3,base=value_of_information:threshold=0.03,at_most=1", task
    )
    assert (policy.samples, policy.steps, policy.price) == (2, 3, None)
    assert (policy.base.threshold, policy.base.at_most) == (0.03, 1)
    assert policy.knowledge == "scheduler_memory"
    nested: Any = make_policy(
        "rollout:samples=1,steps=1,base=value_of_information:price=0.1,at_most=2", task
    )
    assert (nested.base.price, nested.base.at_most) == (0.1, 2)
    free = make_policy("rollout:samples=2,steps=1,price=0,base=never", task)
    dear = make_policy("rollout:samples=2,steps=1,price=1e9,base=never", task)
    assert run_episodes(task, dear, 3, 0).rate.max() == 0.0
    assert run_episodes(task, free, 3, 0).rate.mean() > 0.1


def test_an_input_that_is_the_same_in_every_episode_cannot_be_imagined() -> None:
    task = fusion_gym.make_task(INPUT, input_phase=(0.0, 1.0), horizon=5)
    with pytest.raises(ConfigurationError, match="is not allowed here: it must offer"):
        make_policy("rollout:base=never", task)
