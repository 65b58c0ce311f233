"""What the counterfactual learner is credited with: clipping, ends of episodes, scaled rewards."""

from typing import Any

import numpy as np
import pytest
import torch

import fusion_gym
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.training.counterfactual import CounterfactualPPO, RolloutBatch

ENV = "fusion_gym/TobitOscillator-v1"


def env_of(runs: int = 5, local: bool = False, **options: Any) -> PrivilegedVecEnv:
    return PrivilegedVecEnv(fusion_gym.make_task(ENV, filter="tobit", **options), runs, local=local)


@pytest.mark.parametrize("path_credit", [True, False])
@pytest.mark.parametrize("kind", ["all", "flips", "local"])
def test_the_surrogate_is_clipped_from_below(kind: Any, path_credit: bool) -> None:
    """min(ρ A, clip(ρ) A) (Schulman et al. 2017), of alternatives and of what came later.

    What came later is weighed with the whole action's ratio, the product of its factors', or
    where sensors decide by themselves with each sensor's own. Without ``path_credit`` it does not
    count.
    """
    env = env_of(local=kind == "local")
    model = CounterfactualPPO(
        *("MlpPolicy", env), ent_coef=0.0, vf_coef=0.0, batch_size=30, path_credit=path_credit,
        alternatives=None if kind == "local" else kind,
    )  # fmt: skip
    generator = torch.Generator().manual_seed(3)
    rows = (6, 3) if kind == "local" else (6,)
    observations = torch.randn((*rows, *env.observation_space.shape), generator=generator)  # type: ignore[misc]
    decisions = model._decisions
    new = decisions.log_probabilities(model._logits(observations)).detach()
    old = (new + torch.randn(new.shape, generator=generator)).log_softmax(-1)
    advantages = torch.randn(new.shape, generator=generator)
    surplus = torch.randn(6, generator=generator)
    choice = torch.randint(0, decisions.choices, new.shape[:2], generator=generator)
    rollout = RolloutBatch(
        observations, choice, old, advantages, surplus, torch.zeros(6), torch.zeros(6)
    )
    loss, _ = model._loss(rollout, torch.arange(6), 1.0, 0.2)

    def clipped(ratio: Any, credit: Any) -> Any:
        return np.where(credit > 0.0, np.minimum(ratio, 1.2), np.maximum(ratio, 0.8)) * credit

    ratio, taken = (new - old).exp().numpy(), (new - old).gather(-1, choice[..., None])
    gain = (old.exp().numpy() * clipped(ratio, advantages.numpy())).sum((-1, -2))
    change = taken[..., 0] if kind == "local" else taken.sum((-1, -2))[:, None]
    late = clipped(change.exp().numpy(), surplus.numpy()[:, None]).sum(-1)
    np.testing.assert_allclose(float(loss.detach()), -(gain + path_credit * late).mean(), rtol=1e-4)


@pytest.mark.parametrize("action", ["binary", "multidiscrete", "discrete"])
def test_the_credited_chances_are_the_policys(action: str) -> None:
    env = env_of(action=action)
    env.reset()
    model: Any = CounterfactualPPO("MlpPolicy", env, batch_size=30, seed=0)
    with torch.no_grad():
        model.policy.action_net.weight.mul_(100.0)
    observations = torch.rand((5, *model.observation_space.shape))
    values = model._decisions.log_probabilities(model._logits(observations))
    choice = torch.randint(0, model._decisions.choices, values.shape[:2])
    actions = torch.as_tensor(model._decisions.actions(choice.numpy())).float()
    expected = model.policy.evaluate_actions(observations, actions)[1]
    torch.testing.assert_close(values.gather(-1, choice[..., None]).sum((-1, -2)), expected)


def test_an_episode_cut_short_is_worth_what_its_last_observation_is() -> None:
    """Not what the next episode begins with: there the age is less."""
    env = env_of(horizon=2, token_rate=0.0, initial_tokens=0.0)
    model: Any = CounterfactualPPO(
        "MlpPolicy", env, alternatives="flips", n_steps=2, gamma=0.5, gae_lambda=0.0, batch_size=2
    )
    age = env.observation_names.index("age[0]")
    model._critic = lambda observation: 1e6 * observation[..., age]
    _, callback = model._setup_learn(100)
    model.collect_rollouts(env, callback, model.rollout_buffer, 2)
    worth = model._rollout.returns.reshape(2, -1).numpy() / 0.5e6
    np.testing.assert_allclose(worth, [[2.0 / 12.0] * 5, [3.0 / 13.0] * 5], rtol=1e-4)


def test_an_alternative_that_is_what_was_done_pays_the_same() -> None:
    """Also where rewards are scaled by the price of the episode."""
    price = {"cost_weight": "random", "price_range": (0.003, 0.3)}
    task = fusion_gym.make_task(ENV, filter="tobit", **price)
    env = PrivilegedVecEnv(task, 8, price_exponent=0.5)
    env.reset()
    actions = np.random.default_rng(0).integers(0, 2, (8, 3))
    (_, rewards, *_), other = env.step_alternatives(actions, (actions.T == 1)[None])
    np.testing.assert_allclose(other.reward[0], rewards, rtol=1e-6)
