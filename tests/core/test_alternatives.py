"""What other requests would have brought: the steps that would have been, and nothing moves."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_configs import small_config

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.memory import Owner
from fusion_gym.core.runs import Branch
from fusion_gym.core.task import Task
from fusion_gym.envs.privileged import (
    Alternatives,
    PrivilegedVecEnv,
    alternatives,
    make_sb3_vec_env,
    reference_estimator,
)
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.training.config import Experiment, load_checked
from fusion_gym.training.run import make_env
from fusion_gym.validation import ConfigurationError

OSCILLATOR, LINEAR = "fusion_gym/TobitOscillator-v1", "fusion_gym/LinearFusion-v2"
TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": (OSCILLATOR, {"horizon": 6}),
    "starved": (OSCILLATOR, {"token_rate": 2.0, "initial_tokens": 3.0, "sharing": "fixed"}),
    "queue": (OSCILLATOR, {"token_rate": 2.0, "initial_tokens": 3.0, "sharing": "turns"}),
    "memory": (OSCILLATOR, {"filter": "tobit", "memory": True, "horizon": 5}),
    "estimates": (OSCILLATOR, {"filter": "tobit", "memory": True, "packet": "estimate"}),
    "heard": (OSCILLATOR, {"filter": "tobit", "memory": True, "broadcast": "packets"}),
    "single": (OSCILLATOR, {"access": "single", "sharing": "equal"}),
    "random": ("fusion_gym/BiasedTracking-v1", {"access": "random", "memory": True}),
    "turns": ("fusion_gym/BiasedOscillator-v2", {"access": "round_robin"}),
    "correlated": ("fusion_gym/CorrelatedTracking-v1", {"memory": True, "noise_scale": "random"}),
    "markov": ("fusion_gym/MarkovJumpTracking-v1", {"information": "centre"}),
    "unknown": ("fusion_gym/UnknownInput-v1", {"memory": True, "horizon": 5}),
    "remote": (
        "fusion_gym/RemoteEstimation-v1",
        {"sensors": 2, "channel": "gilbert_elliott", "memory": True, "cost_weight": "random",
         "price_range": (0.1, 1.0)},
    ),
    "departed": (
        OSCILLATOR, {"filter": "tobit", "memory": True, "true_process_noise": (0.5, 2.0),
                     "true_transition": (0.9, 1.1), "true_threshold_shift": 0.3},
    ),
    "loop": (LINEAR, {"input_matrix": [[0.0], [0.5]], "memory": True, "horizon": 5}),
    "loop, own": (LINEAR, {"input_matrix": [[0.0], [0.5]], "gain": [[0.5, 1.0]], "memory": True}),
    "many": ("fusion_gym/RemoteEstimation-v1", {"sensors": 70, "token_rate": 3.0}),
}  # fmt: skip
RUNS = 4


def build_parts(name: str) -> Task:
    env_id, options = TASKS[name]
    return fusion_gym.make_task(env_id, **options)


def contents(runs: Any) -> list[bytes]:
    """Everything that runs show of themselves."""
    parts = [runs.observe(), runs.tokens, runs.price, runs.steps, runs.admitted()]
    parts.append(runs.state.network.queue)
    return [np.ascontiguousarray(part).tobytes() for part in parts]


def stepped(
    before: Branch, batch: EpisodeBatch, requests: np.ndarray, request: np.ndarray
) -> Alternatives:
    """The batch's step on ``requests`` and the alternatives ``request``."""
    outcome = batch.step(requests)
    return alternatives(before, request, batch.normals(), outcome, batch.observe(), batch.beliefs())


@pytest.mark.parametrize(
    ("name", "owner"),
    [*((name, "scheduler") for name in TASKS), ("heard", "own"), ("unknown", "own")],
)
def test_alternatives_are_the_steps_that_would_have_been(name: str, owner: Owner) -> None:
    """Also of runs that have finished; and neither the batch nor the branch moves."""
    task = build_parts(name)
    batch = EpisodeBatch.seeded(task, RUNS, 3, owner)
    rng = np.random.default_rng(0)
    for _ in range(6):
        many = rng.random((6, task.sensors, RUNS)) < 0.5
        many[1] = False
        requests = many[0]
        before, branches = batch.branch(), [batch.branch() for _ in many]
        stood = contents(before)
        result = stepped(before, batch, requests, many)
        assert contents(before) == stood
        went = contents(batch)
        for place, branch in enumerate(branches):
            outcome = branch.step(many[place], batch.normals())
            np.testing.assert_array_equal(result.error[:, place], outcome.error)
            np.testing.assert_array_equal(result.reward_error[place], outcome.reward_error)
            np.testing.assert_array_equal(result.communication[place], outcome.reward_communication)
            np.testing.assert_array_equal(result.observation[place], branch.observe())
        assert contents(batch) == went


@pytest.mark.parametrize("sensors", [40, 60, 62, 64])
def test_grants_of_many_sensors_are_reported_apart(sensors: int) -> None:
    """However many bits they take: each alternative is the request of one of the last sensors."""
    task = fusion_gym.make_task(
        "fusion_gym/RemoteEstimation-v1", sensors=sensors, tokens="unlimited"
    )
    batch = EpisodeBatch.seeded(task, 512, 0)
    request = np.zeros((6, sensors, 512), dtype=np.bool_)
    request[np.arange(6), np.arange(sensors - 6, sensors)] = True
    before = batch.branch()
    values = stepped(batch.branch(), batch, np.zeros((sensors, 512), dtype=np.bool_), request)
    for place, requests in enumerate(request):
        outcome = before.branch().step(requests, batch.normals())
        np.testing.assert_array_equal(values.error[:, place], outcome.error)


def test_requests_that_are_answered_alike_are_stepped_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody is granted anything without tokens, and what was taken is known already."""
    task = fusion_gym.make_task(OSCILLATOR, token_rate=0.5, initial_tokens=3.0, sharing="fixed")
    batch = EpisodeBatch.seeded(task, 2, 0)
    counted: list[int] = []
    take = Branch.step

    def step(self: Branch, requests: Any, *rest: Any) -> Any:
        counted.append(requests.shape[1])
        return take(self, requests, *rest)

    monkeypatch.setattr(Branch, "step", step)
    everything = (np.arange(8)[:, None] >> np.arange(3) & 1).astype(np.bool_)[:, :, None]
    request = np.broadcast_to(everything, (8, 3, 2))
    requests = np.zeros((3, 2), dtype=np.bool_)
    requests[0, 0] = True
    stepped(batch.branch(), batch, requests, request)
    assert counted == [6]  # one packet can be paid: four answers in each run, one of them taken
    stepped(batch.branch(), batch, requests, request)
    # The first run has nothing left; the second has had no use for its tokens.
    assert counted == [6, 3]


@pytest.mark.parametrize(
    ("name", "local"),
    [
        ("memory", False),
        ("memory", True),
        ("correlated", False),
        ("markov", True),
        ("remote", False),
    ],
)
def test_the_reference_takes_in_every_measurement(name: str, local: bool) -> None:
    """Whoever decides, whatever is sent: the error of a centre that receives everything."""
    env_id, options = TASKS[name]
    options = {**options, "horizon": 4} | ({"information": "sensors"} if local else {})
    task = fusion_gym.make_task(env_id, **options)
    owner: Owner | None = ("own" if local else "scheduler") if task.options.memory else None
    batch = EpisodeBatch(task, RUNS, owner, reference_estimator(env_id, options))
    plain = EpisodeBatch(task, RUNS, owner)
    free = fusion_gym.make_task(env_id, **options | {"tokens": "unlimited"})
    receiving = EpisodeBatch(free, RUNS, owner)
    every = (batch, plain, receiving)
    for item in every:
        item.seed(np.arange(RUNS), [5 + run for run in range(RUNS)])
        item.reset(stagger=True)
    rng = np.random.default_rng(0)
    for _ in range(9):
        requests = rng.random((task.sensors, RUNS)) < 0.3
        batch.step(requests)
        plain.step(requests)
        received = receiving.step(np.ones((task.sensors, RUNS), dtype=np.bool_)).error
        assert contents(batch) == contents(plain)
        # All packets arrive at it, and remote estimation has a perfect measurement in each.
        request = np.zeros_like(received) if name == "remote" else received
        np.testing.assert_allclose(batch.reference_error, request, rtol=1e-12, atol=1e-12)
        done = np.flatnonzero(batch.finished)
        for item in every if done.size else ():
            item.reset(done)


@pytest.mark.parametrize("error", ["squared", "excess", "mismatch"])
def test_rewards_of_a_training_are_made_of_the_two_errors(error: str) -> None:
    """And those of the alternatives too; what infos tell of an episode is the task's own."""
    options = {"filter": "tobit", "horizon": 3, "state_weights": [1.0, 2.0], "error_weight": 0.5}
    task = fusion_gym.make_task(OSCILLATOR, **options)
    reference = reference_estimator(OSCILLATOR, options)
    env = PrivilegedVecEnv(task, RUNS, error=error, reference=reference)
    true = EpisodeBatch(task, RUNS, None, reference)
    env.seed(7)
    env.reset()
    true.seed(np.arange(RUNS), [7 + run for run in range(RUNS)])
    true.reset()
    rng = np.random.default_rng(0)
    request = np.broadcast_to(
        np.array([[True, False, False], [False] * 3])[:, :, None], (2, 3, RUNS)
    )
    returns = np.zeros(RUNS)
    for _ in range(3):
        actions = rng.integers(0, 2, (RUNS, 3))
        before = true.branch()
        outcome = true.step(actions.T == 1)
        (_, reward, _, infos), branched = env.step_alternatives(actions, request)

        def term(value: np.ndarray) -> np.ndarray:
            own, best = value, true.reference_error
            squared = {
                "squared": own**2, "excess": own**2 - best**2, "mismatch": (own - best) ** 2
            }[error]  # fmt: skip
            return np.asarray(-0.5 * (squared[0] + 2.0 * squared[1]))

        own = term(outcome.error) + outcome.reward_communication
        np.testing.assert_allclose(reward, own, rtol=1e-6)
        for place, requests in enumerate(request):
            other = before.branch().step(requests, true.normals())
            np.testing.assert_allclose(
                branched.reward[place], term(other.error) + other.reward_communication, rtol=1e-9
            )
        returns += outcome.reward
    np.testing.assert_allclose([info["episode"]["r"] for info in infos], returns, rtol=1e-9)


def test_a_training_error_that_does_not_fit_is_refused() -> None:
    task = fusion_gym.make_task(OSCILLATOR)
    with pytest.raises(ConfigurationError, match="error = 'mismatch' is not allowed"):
        PrivilegedVecEnv(task, 2, error="mismatch")
    claimed = fusion_gym.make_task(OSCILLATOR, error="trace")
    with pytest.raises(ConfigurationError, match="error = 'excess' is not allowed"):
        PrivilegedVecEnv(claimed, 2, error="excess", reference=task.estimator)
    with pytest.raises(ConfigurationError, match="memory_filter"):
        reference_estimator("fusion_gym/RemoteEstimation-v1", {}, "adf")


@pytest.mark.parametrize("local", [False, True])
def test_looking_at_alternatives_changes_nothing(local: bool) -> None:
    """Rows, rewards, ends and infos are those of the plain environment, but for its groups."""
    options: dict[str, Any] = {"filter": "tobit", "memory": True, "horizon": 5}
    task = fusion_gym.make_task(OSCILLATOR, **options)
    plain = FusionSB3VecEnv(task, RUNS, local=local)
    env = PrivilegedVecEnv(task, RUNS, local=local)
    for item in (plain, env):
        item.seed(3)
    assert plain.reset().tobytes() == env.reset().tobytes()
    rng = np.random.default_rng(0)
    for _ in range(12):
        actions = rng.integers(0, 2, RUNS * 3 if local else (RUNS, 3))
        requests = rng.random((2, 3, RUNS)) < 0.5
        item, (two, _) = plain.step(actions), env.step_alternatives(actions, requests)
        for left, right in zip(item[:3], two[:3], strict=True):
            assert np.asarray(left).tobytes() == np.asarray(right).tobytes()
        assert [info.keys() for info in item[3]] == [info.keys() for info in two[3]]
        for left, right in zip(item[3], two[3], strict=True):
            if left:
                assert (
                    left["terminal_observation"].tolist() == right["terminal_observation"].tolist()
                )
                assert left["episode"]["r"] == right["episode"]["r"]


@pytest.mark.parametrize("kind", ["mismatch", "excess"])
def test_rewards_without_what_no_policy_changes(kind: str) -> None:
    """Requests of nobody: rewards of the training differ, returns in infos are the task's."""
    usual = make_sb3_vec_env(OSCILLATOR, 4, seed=0, horizon=5, filter="tobit")
    other = make_sb3_vec_env(OSCILLATOR, 4, seed=0, training_error=kind, horizon=5, filter="tobit")
    total = np.zeros(4)
    for env in (usual, other):
        env.reset()
    for _ in range(5):
        nobody = np.zeros((4, 3), dtype=np.int8)
        seen, rewards, _, infos = usual.step(nobody)
        again, changed, _, others = other.step(nobody)
        np.testing.assert_array_equal(seen, again)
        assert not np.allclose(rewards, changed)
        total += rewards
    for run in range(4):
        assert infos[run]["episode"]["r"] == others[run]["episode"]["r"]
        assert others[run]["episode"]["r"] == pytest.approx(total[run], rel=1e-5)


def test_another_training_error_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="training_error = 'trace' is not allowed"):
        make_sb3_vec_env(OSCILLATOR, 4, training_error="trace")


def test_a_memory_that_is_there_is_the_reference_and_changes_no_reward(tmp_path: Path) -> None:
    options = {"filter": "tobit", "horizon": 30, "memory": True, "memory_filter": "adf"}
    training = {"timesteps": 64, "num_envs": 4, "error": "mismatch"}
    environment = {"id": OSCILLATOR, "options": options}
    experiment = load_checked(
        Experiment, small_config(tmp_path, environment=environment, training=training)
    )
    task = fusion_gym.make_task(OSCILLATOR, **options)
    env = make_env(experiment, task)
    assert env.batch.reference is task.memory_estimator

    def rewards(env: Any) -> list[Any]:
        env.seed(5)
        env.reset()
        return [env.step(np.eye(4, 3, k=step % 3 - 1, dtype=np.int8))[1] for step in range(40)]

    other = reference_estimator(OSCILLATOR, options)
    apart = PrivilegedVecEnv(task, 4, error="mismatch", reference=other, stagger=True)
    np.testing.assert_array_equal(rewards(env), rewards(apart))
