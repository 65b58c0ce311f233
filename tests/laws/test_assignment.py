"""Laws of an assignment: channels whose quality differs for each pair of sensor and channel."""

import itertools
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from cases import QUALITY, SCARCE, requests
from refusals import refused
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

import fusion_gym
from fusion_gym.core.access import assign, channel_requests
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.pages import page
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.onnx_export import DecisionGraph
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import ModelPolicy, load_model_policy, tag_model
from fusion_gym.training.counterfactual import CounterfactualPPO, Decisions
from fusion_gym.validation import ConfigurationError

NAME, RUNS = "fusion_gym/CorrelatedTracking-v1", 5
PAIRS: dict[str, Any] = {"access": "assignment", "channels": 2, "tokens": "unlimited"}
LOSSY = PAIRS | {"channel": "independent", "drop_probability": QUALITY}
FADING = PAIRS | {"channel": "gilbert_elliott"}
ASSIGNED = LOSSY | {"action": "assignment", "horizon": 20}
LEARNERS = [PPO, MaskablePPO, CounterfactualPPO]


def task_of(**options: Any) -> Any:
    return fusion_gym.make_task(NAME, **options)


# --- the lines of a user --------------------------------------------------------------------------


def test_a_user_assigns_channels() -> None:
    env = gymnasium.make(NAME, **ASSIGNED)
    env.reset(seed=0)
    assert env.action_space == gymnasium.spaces.MultiDiscrete([4, 4])
    for action, granted in (([1, 2], [1, 1, 0]), ([0, 3], [0, 0, 1]), ([2, 2], [0, 1, 0])):
        *_, info = env.step(action)
        np.testing.assert_array_equal(info["granted"], granted)
        assert info["cost"] == 3.0 * sum(granted)
    with pytest.raises(ValueError, match=r"action \[1\] = 4 is not allowed: it must be 0..3"):
        env.step([0, 4])
    with pytest.raises(ValueError, match="shape"):
        env.step([0, 0, 0])


def test_a_user_reads_the_quality_of_the_links() -> None:
    batch = EpisodeBatch.seeded(task_of(**LOSSY), 3, 0)
    signals = batch.signals()
    expected = 1.0 - np.array(QUALITY)
    np.testing.assert_allclose(signals["link_probability"], expected[..., None].repeat(3, -1))
    best = expected.max(1)
    np.testing.assert_allclose(signals["arrival_probability"], best[:, None].repeat(3, -1))


# --- closed forms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"true_drop_probability": 0.5}], ids=str)
def test_each_pair_delivers_at_its_own_rate(options: dict[str, Any]) -> None:
    """1 minus its probability of a loss, or the true one."""
    task, runs, steps = task_of(**LOSSY, **options), 400, 20
    for sensor, channel in itertools.product(range(3), range(2)):
        batch, arrived = EpisodeBatch.seeded(task, runs, 3), 0
        asked = np.where(np.arange(3)[:, None] == sensor, channel + 1, 0).repeat(runs, 1)
        for _ in range(steps):
            outcome = batch.step(asked)
            np.testing.assert_array_equal(outcome.granted, asked > 0)
            arrived += int(outcome.arrived.sum())
        expected = 1.0 - (QUALITY[sensor][channel] if not options else 0.5)
        assert arrived / (runs * steps) == pytest.approx(expected, abs=0.022)


@pytest.mark.parametrize("drop", [0.3, (0.1, 0.5, 0.9)])
def test_one_probability_holds_on_every_channel(drop: Any) -> None:
    task = task_of(**LOSSY | {"drop_probability": drop})
    links = EpisodeBatch.seeded(task, 1, 0).signals()["link_probability"][..., 0]
    np.testing.assert_allclose(links, 1.0 - np.broadcast_to(drop, (2, 3)).T)


def test_each_pair_has_a_chain_of_its_own() -> None:
    """Stationary, good with 3/4, uncorrelated with the others, and moving by its matrix."""
    batch = EpisodeBatch.seeded(task_of(**FADING), 3000, 0)
    before, moves = batch.signals()["channel_state"], np.zeros((2, 2))
    assert before.shape == (3, 2, 3000)
    for _ in range(4):
        batch.step(np.zeros((3, 3000), dtype=np.bool_))
        state = batch.signals()["channel_state"]
        np.testing.assert_allclose(state.mean(-1), 0.75, atol=0.035)
        np.testing.assert_allclose(np.corrcoef(state.reshape(6, -1)), np.eye(6), atol=0.08)
        for last, now in itertools.product(range(2), range(2)):
            moves[last, now] += ((before == last) & (state == now)).sum()
        before = state
    expected = [[0.7, 0.3], [0.1, 0.9]]
    np.testing.assert_allclose(moves / moves.sum(1, keepdims=True), expected, atol=0.015)


def test_a_fading_link_arrives_by_its_state() -> None:
    """The entries show the same states."""
    batch = EpisodeBatch.seeded(task_of(**FADING), 4000, 0)
    names = list(batch.layout.names)
    for _ in range(3):
        signals = batch.signals()
        state, chance = signals["channel_state"], signals["link_probability"]
        shown = batch.observe()[:, names.index("channel[2,1,good]")]
        np.testing.assert_array_equal(shown, state[2, 1])
        loss = np.array([[0.7, 0.3], [0.1, 0.9]]) @ [0.7, 0.2]
        np.testing.assert_allclose(chance, 1.0 - loss[state])
        arrived = batch.step(np.array([[0], [0], [2]]).repeat(4000, 1)).arrived[2]
        for kind in range(2):
            here = state[2, 1] == kind
            assert arrived[here].mean() == pytest.approx(1.0 - loss[kind], abs=0.06)


# --- the assignment of the network ----------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 2, 3, 5])
def test_the_network_assigns_greedily(channels: int) -> None:
    """In the order of the queue, each the best of what is left."""
    rng, runs = np.random.default_rng(0), 60
    chance = rng.random((4, channels, runs)).round(1)
    place = np.argsort(rng.random((4, runs)), 0)
    granted = rng.random((4, runs)) < 0.6
    for run in range(runs):
        over = [s for s in np.argsort(place[:, run]) if granted[s, run]][channels:]
        granted[over, run] = False
    result = assign(granted, place, chance)
    for run in range(runs):
        free = list(range(channels))
        for sensor in np.argsort(place[:, run]):
            if not granted[sensor, run]:
                assert result[sensor, run] == 0
                continue
            best = max(free, key=lambda channel: chance[sensor, channel, run])
            free.remove(best)
            assert result[sensor, run] == best + 1


@pytest.mark.parametrize("scarce", [False, True])
def test_requests_without_channels_go_where_the_network_assigns_them(scarce: bool) -> None:
    """Bitwise as the requests with these channels."""
    for options in (LOSSY, FADING):
        task = task_of(**options | (SCARCE if scarce else {}))
        batches = [EpisodeBatch.seeded(task, RUNS, 0) for _ in range(2)]
        for request in requests(task, RUNS, 12, rate=0.8):
            place = batches[0].state.network.queue
            granted = batches[0].answer(request).granted
            assert (granted.sum(0) <= 2).all()
            chance = np.asarray(batches[0].signals()["link_probability"])
            channels = assign(granted, place, chance)
            outcomes = [b.step(r) for b, r in zip(batches, (request, channels), strict=True)]
            np.testing.assert_array_equal(outcomes[0].arrived, outcomes[1].arrived)
            np.testing.assert_array_equal(outcomes[0].error, outcomes[1].error)


def test_a_channel_that_two_ask_for_goes_to_the_first_in_the_queue() -> None:
    batch = EpisodeBatch.seeded(task_of(**PAIRS), 200, 0)
    rng = np.random.default_rng(0)
    for _ in range(6):
        asked, queue = rng.integers(0, 3, (3, 200)), batch.state.network.queue.copy()
        outcome = batch.step(asked)
        np.testing.assert_array_equal(outcome.requested, asked > 0)
        for channel in (1, 2):
            there = np.where(asked == channel, queue, 9)
            first = (there == there.min(0)) & (there < 9)
            np.testing.assert_array_equal(outcome.granted & (asked == channel), first)


def test_a_sensor_on_several_channels_uses_the_first() -> None:
    every = np.array(list(itertools.product(range(4), repeat=3))).T
    result = channel_requests(every, 3)
    for run, assignment in enumerate(every.T.tolist()):
        expected = [assignment.index(m) + 1 if m in assignment else 0 for m in (1, 2, 3)]
        assert result[:, run].tolist() == expected


# --- interfaces -----------------------------------------------------------------------------------


def test_help_describes_the_action() -> None:
    text = page(NAME, task_of(**FADING, action="assignment"))
    assert "MultiDiscrete([4 4])" in text
    assert "The number of each channel is 0 for nobody" in text


def test_sensors_that_decide_locally_leave_the_channels_to_the_network() -> None:
    env = fusion_gym.parallel_env(NAME, **ASSIGNED | {"action": "binary"})
    env.reset(seed=0)
    *_, infos = env.step(dict.fromkeys(env.agents, 1))
    assert sum(info["granted"] for info in infos.values()) == 2


def test_the_functional_environment_assigns() -> None:
    jax = pytest.importorskip("jax")
    from fusion_gym.jax import make

    env, _ = make("fusion_gym/RemoteEstimation-v1", sensors=3, **ASSIGNED)
    assert env.num_actions == 2
    _, state = jax.jit(env.reset)(jax.random.key(0))
    noise, step = np.zeros((env._channels, 1)), jax.jit(env.step_env)
    for action in itertools.product(range(4), repeat=2):
        outcome = step(noise, state, np.array(action))[2]
        expected = channel_requests(np.array(action)[:, None], 3)
        np.testing.assert_array_equal(outcome.granted, expected > 0)
    keys = jax.random.split(jax.random.key(1), 3)
    _, states = jax.jit(jax.vmap(env.reset))(keys)
    *_, info = jax.jit(jax.vmap(env.step))(keys, states, np.array([[1, 2], [3, 3], [0, 0]]))
    np.testing.assert_array_equal(info["granted"], [[1, 1, 0], [0, 0, 1], [0, 0, 0]])


# --- learning -------------------------------------------------------------------------------------


def test_masks_open_who_is_grantable_on_every_channel() -> None:
    envs = fusion_gym.make_sb3_vec_env(NAME, RUNS, seed=0, **ASSIGNED | SCARCE)
    envs.reset()
    closed = 0
    for _ in range(10):
        masks, grantable = envs.action_masks().reshape(RUNS, 2, 4), envs.batch.grantable()
        assert masks[..., 0].all()
        for channel in range(2):
            np.testing.assert_array_equal(masks[:, channel, 1:], grantable.T)
        closed += int((~masks).sum())
        envs.step(np.array([[1, 2]] * RUNS))
    assert closed


@pytest.mark.parametrize("learner", LEARNERS)
def test_agents_learn_and_are_loaded(learner: Any, tmp_path: Path) -> None:
    task = task_of(**ASSIGNED)
    env = PrivilegedVecEnv(task, RUNS, stagger=True)
    model = learner("MlpPolicy", env, n_steps=8, batch_size=20, n_epochs=1, seed=0, device="cpu")
    before = [part.clone() for part in model.policy.parameters()]
    model.learn(80)
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
    tag_model(model, task)
    model.save(tmp_path / "agent")
    policy = load_model_policy(tmp_path / "agent.zip", task)
    assert policy(EpisodeBatch.seeded(task, 4, 0).signals()).dtype == np.int64
    assert np.isfinite(run_episodes(task, policy, 3).returns).all()
    refused(lambda: DecisionGraph(ModelPolicy(model, task)), "action = 'assignment'")
    refused(lambda: ModelPolicy(model, task).check_logits(), "it must be MultiBinary")
    more = ASSIGNED | {"memory": True, "belief_features": ()}
    with pytest.raises(ConfigurationError, match=r"base = .*assigns no channels"):
        make_policy(f"rollout:base=model:{tmp_path / 'agent.zip'}", task_of(**more))
    with pytest.raises(ConfigurationError, match="action space"):
        load_model_policy(tmp_path / "agent.zip", task_of(access="slots", slots=2))


@pytest.mark.parametrize("options", [{}, SCARCE, {"memory": True}], ids=str)
def test_credit_of_a_channel_is_that_of_its_alternatives(options: dict[str, Any]) -> None:
    """Each is stepped alone on the same noise."""
    env = PrivilegedVecEnv(task_of(**ASSIGNED | options), RUNS)
    env.seed(0)
    env.reset()
    decisions, rng = Decisions(env, None), np.random.default_rng(0)
    logits = torch.randn((RUNS, 8), generator=torch.Generator().manual_seed(0))
    values = decisions.log_probabilities(logits)
    assert values.shape == (RUNS, 2, 4)
    for _ in range(6):
        choice = rng.integers(0, 4, (RUNS, 2))
        categorical = torch.distributions.Categorical(logits=logits.reshape(RUNS, 2, 4))
        taken = values.gather(-1, torch.as_tensor(choice)[..., None])[..., 0]
        torch.testing.assert_close(taken, categorical.log_prob(torch.as_tensor(choice)))
        before = env.batch.branch()
        others = decisions.alternatives(choice)
        (_, reward, *_), branched = env.step_alternatives(decisions.actions(choice), others)
        credit = decisions.arranged(choice, reward, branched.reward)
        for channel, sensor in itertools.product(range(2), range(4)):
            other = choice.copy()
            other[:, channel] = sensor
            branch = before.branch()
            outcome = branch.step(channel_requests(other.T, 3), env.batch.normals())
            np.testing.assert_allclose(credit[:, channel, sensor], outcome.reward, rtol=1e-9)
    refused(lambda: Decisions(env, "all"), "alternatives = 'all'", "assigns channels")


def test_an_untrained_agent_begins_at_its_rate() -> None:
    envs = fusion_gym.make_sb3_vec_env(NAME, RUNS, **ASSIGNED)
    shares = np.exp(envs.view.action.logits(0.3)).reshape(2, 4)
    np.testing.assert_allclose(shares.sum(1), 1.0)
    np.testing.assert_allclose(shares[:, 1:], 0.15)
    refused(lambda: envs.view.action.logits(0.7), "initial_rate = 0.7", "< 2/3")


# --- what works with it, and what does not --------------------------------------------------------


@pytest.mark.parametrize("options", [LOSSY, FADING], ids=["independent", "fading"])
def test_a_rollout_simulates_the_links(options: dict[str, Any]) -> None:
    task = task_of(memory=True, horizon=6, **options)
    policy = make_policy("rollout:samples=4,steps=2,base=never", task)
    assert run_episodes(task, policy, 2).rate.sum() > 0.0


def test_senders_without_acknowledgements_suppose_an_arrival() -> None:
    task = task_of(**LOSSY, acknowledgements="none")
    batch = EpisodeBatch.seeded(task, 60, 0)
    outcome = batch.step(np.array([[2], [1], [0]]).repeat(60, 1))
    np.testing.assert_array_equal(outcome.granted.sum(1), [60, 60, 0])
    assert (outcome.arrived.sum(1)[:2] < 40).all()
    age = task.estimator.read(batch.known_to(local=True))["age"]
    assert (np.asarray(age)[:2] == 1).all()


@pytest.mark.parametrize(
    ("access", "value"), [("any", 1), ("slots", 1), ("assignment", 3), ("assignment", -1)]
)
def test_channels_that_are_not_there_are_refused(access: str, value: Any) -> None:
    channels = {"channels": 2} if access == "assignment" else {}
    batch = EpisodeBatch.seeded(task_of(access=access, **channels), 2, 0)
    refused(lambda: batch.step(np.full((3, 2), value)), "requests = ")
