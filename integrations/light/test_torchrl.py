"""TorchRL: single environments, the native vector environment in all modes, agents, learning."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential
from tensordict.nn import TensorDictModule as Module
from torch.distributions import Bernoulli, Independent
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, GymWrapper, PettingZooWrapper, check_env_specs
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import fusion_gym
from integrations.page import run

TOBIT = "fusion_gym/TobitOscillator-v1"
OPTIONS: dict[str, Any] = {"filter": "tobit", "horizon": 5}
ENDS = [False, False, False, False, True] * 2 + [False] * 2


def vector(mode: str, **options: Any) -> GymWrapper:
    envs = gym.make_vec(TOBIT, num_envs=3, autoreset_mode=mode, **OPTIONS, **options)
    return GymWrapper(envs)


def test_the_page() -> None:
    names = run("TorchRL")
    assert names["single"].shape == (30,)
    step = names["single"]["next"]
    terms = step["reward_error"] + step["reward_cost"]
    torch.testing.assert_close(terms.to(torch.float32), step["reward"].squeeze(-1))
    assert names["many"].shape == (64, 50)
    assert names["many"]["next", "done"].sum() == 64 * 2
    assert names["local"]["state"].shape == (30, len(names["sensors"].state_names))
    assert names["local"]["sensor", "observation"].shape[:2] == (30, 3)


@pytest.mark.parametrize("action", ["binary", "multidiscrete", "discrete"])
@pytest.mark.parametrize("make", [GymEnv, lambda name, **o: GymWrapper(gym.make(name, **o))])
def test_single_environments(make: Any, action: str) -> None:
    env = make(TOBIT, action=action, **OPTIONS)
    check_env_specs(env)
    rollout = env.rollout(12, break_when_any_done=False)
    assert rollout["next", "done"].ravel().tolist() == ENDS
    assert rollout["next", "truncated"].ravel().tolist() == ENDS
    assert not rollout["next", "terminated"].any()
    shape = {"binary": (3,), "multidiscrete": (3, 2), "discrete": (8,)}[
        action
    ]  # one-hot but binary
    assert rollout["action"].shape == (12, *shape)
    clocked = make(TOBIT, action=action, clock=True, **OPTIONS).rollout(5)
    assert clocked["next", "terminated"].ravel().tolist() == ENDS[:5]


@pytest.mark.parametrize("mode", ["Disabled", "SameStep"])
def test_vector_environments_run_the_episodes_of_single_ones(mode: str) -> None:
    envs = vector(mode)
    check_env_specs(envs)
    envs.set_seed(4)
    torch.manual_seed(0)
    rollout = envs.rollout(12, break_when_any_done=False)
    assert rollout["next", "done"].squeeze(-1).tolist() == [ENDS] * 3
    single = gym.make(TOBIT, **OPTIONS)
    single.reset(seed=4)  # what set_seed does; the rollout begins with a reset of its own
    observation = torch.as_tensor(single.reset()[0])
    for step in range(12):
        torch.testing.assert_close(rollout["observation"][0, step], observation, rtol=0, atol=0)
        after, reward, *_, over, info = single.step(rollout["action"][0, step].numpy())
        torch.testing.assert_close(
            rollout["next", "observation"][0, step], torch.as_tensor(after), rtol=0, atol=0
        )
        assert rollout["next", "reward"][0, step].item() == pytest.approx(reward, rel=1e-6)
        if mode == "SameStep":  # with infos, the last of an episode too
            assert rollout["next", "cost"][0, step].item() == info["cost"]
        if over and mode == "SameStep":  # TorchRL resets once more where all runs end together
            single.reset()
        observation = torch.as_tensor(single.reset()[0] if over else after)


def test_the_mode_that_torchrl_refuses() -> None:
    with pytest.raises(RuntimeError, match="must be one of SAME_STEP or DISABLED"):
        vector("NextStep")


def test_rewards_of_two_terms() -> None:
    rollout = vector("Disabled", reward="vector").rollout(5)
    assert rollout["next", "reward"].shape == (3, 5, 2)
    assert (rollout["next", "reward"] <= 0.0).all()


def test_sensors_as_agents_with_a_joint_state() -> None:
    env = PettingZooWrapper(
        fusion_gym.parallel_env(TOBIT, **OPTIONS), use_mask=False, return_state=True
    )
    check_env_specs(env)
    rollout = env.rollout(12, break_when_any_done=False)
    assert rollout["next", "done"].ravel().tolist() == ENDS
    granted = rollout["next", "sensor", "info", "granted"]
    assert set(granted.unique().tolist()) <= {0.0, 1.0}
    spent = rollout["next", "sensor", "info", "cost"]
    torch.testing.assert_close(spent, 3.0 * granted)  # three tokens a transmission


def test_ppo_takes_a_step() -> None:
    """One collection and update with independent requests of the three sensors."""
    torch.manual_seed(0)
    envs = GymWrapper(gym.make_vec(TOBIT, num_envs=8, autoreset_mode="Disabled", **OPTIONS))
    entries = envs.observation_spec["observation"].shape[-1]
    logits = torch.nn.Sequential(torch.nn.Linear(entries, 32), torch.nn.Tanh(),
                                 torch.nn.Linear(32, 3))  # fmt: skip
    actor = ProbabilisticTensorDictSequential(
        Module(logits, in_keys=["observation"], out_keys=["logits"]),
        ProbabilisticTensorDictModule(
            in_keys=["logits"], out_keys=["action"], return_log_prob=True,
            distribution_class=lambda logits: Independent(Bernoulli(logits=logits), 1),
        ),
    )  # fmt: skip
    critic = ValueOperator(torch.nn.Sequential(torch.nn.Linear(entries, 32), torch.nn.Tanh(),
                                               torch.nn.Linear(32, 1)))  # fmt: skip
    loss, advantage = ClipPPOLoss(actor, critic), GAE(gamma=0.97, lmbda=0.9, value_network=critic)
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3)
    before = logits[0].weight.detach().clone()
    collector = Collector(envs, actor, frames_per_batch=160, total_frames=320)
    values = []
    for batch in collector:
        assert batch.shape == (8, 20)
        advantage(batch)
        terms = loss(batch.reshape(-1))
        total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        values.append(total.item())
    collector.shutdown()
    assert len(values) == 2
    assert torch.isfinite(torch.tensor(values)).all()
    assert not torch.equal(before, logits[0].weight)
