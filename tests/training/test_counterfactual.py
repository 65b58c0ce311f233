"""The counterfactual learner: its arithmetic by definition, and models that are plain PPO's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from training_configs import ENV, small_config

import fusion_gym
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.training import run
from fusion_gym.training.config import TABLE, Experiment, load_checked
from fusion_gym.training.counterfactual import CounterfactualPPO, Decisions, _Step
from fusion_gym.validation import ConfigurationError

RUNS = 5
BERNOULLI, CATEGORICAL = torch.distributions.Bernoulli, torch.distributions.Categorical
CASES: dict[str, tuple[dict[str, Any], bool, str | None]] = {
    "all": ({}, False, None),
    "flips": ({}, False, "flips"),
    "multidiscrete": ({"action": "multidiscrete"}, False, None),
    "discrete": ({"action": "discrete"}, False, None),
    "single": ({"access": "single"}, False, None),
    "local": ({}, True, None),
}


def env_of(name: str, **more: Any) -> tuple[PrivilegedVecEnv, Any]:
    options, local, kind = CASES[name]
    task = fusion_gym.make_task(ENV, **{"filter": "tobit", "horizon": 7, **options, **more})
    return PrivilegedVecEnv(task, RUNS, local=local), kind


@pytest.mark.parametrize("name", CASES)
def test_values_stand_at_the_choices_that_they_are_of(name: str) -> None:
    """A made-up value of the requests, in place of a step: Q is it at every single choice."""
    env, kind = env_of(name)
    decisions, sensors = Decisions(env, kind), 3
    worth = np.array([1.0, 10.0, 100.0])[:, None]
    rng = np.random.default_rng(1)
    width = 3 if decisions.binary else int(env.action_space.n)  # type: ignore[attr-defined]
    logits = decisions.by_run(torch.zeros((env.num_envs, width)))
    factors = decisions.log_probabilities(logits).shape[1]
    action = rng.integers(0, decisions.choices, (RUNS, factors))

    def value_of(choices: Any) -> Any:
        return (worth * env.view.action.requests(decisions.actions(choices), RUNS)).sum(0)

    expected = decisions.alternatives(action)
    stepped = (worth * expected.transpose(1, 0, 2).reshape(sensors, -1)).sum(0).reshape(-1, RUNS)
    values = decisions.arranged(action, value_of(action), stepped)
    for factor in range(factors):
        for choice in range(decisions.choices):
            other = action.copy()
            other[:, factor] = choice
            np.testing.assert_array_equal(values[:, factor, choice], value_of(other))


def test_where_sensors_decide_a_run_is_worth_the_sum_of_its_rows() -> None:
    """What lies beyond an alternative too, whose rows are those that its sensors would see."""
    env, kind = env_of("local")
    model = CounterfactualPPO("MlpPolicy", env, alternatives=kind, batch_size=30)
    rows = env.reset()
    predict: Any = model.policy.predict_values
    for _ in range(3):
        with torch.no_grad():
            apart = predict(torch.as_tensor(rows)).numpy().reshape(RUNS, 3)
        values = model._value(model._decisions.by_run(rows))
        np.testing.assert_allclose(values, apart.sum(1), rtol=1e-5)
        choice = np.random.default_rng(0).integers(0, 2, (RUNS, 3))
        before = env.batch.branch()
        actions = model._decisions.actions(choice)
        _, branched = env.step_alternatives(actions, model._decisions.alternatives(choice))
        beyond = model._beyond(branched.observation)
        for sensor in range(3):
            flipped = choice.T == 1
            flipped[sensor] ^= True
            branch = before.branch()
            branch.step(flipped, env.batch.normals())
            with torch.no_grad():
                apart = predict(torch.as_tensor(env.view.rows(branch.observe()))).numpy()
            np.testing.assert_allclose(beyond[sensor], apart.reshape(RUNS, 3).sum(1), rtol=1e-5)
        rows = env._observe()


@pytest.mark.parametrize("clock", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_nothing_has_a_value_after_an_end_that_the_clock_shows(name: str, clock: bool) -> None:
    """A critic that says 3 everywhere is asked for what lies beyond the horizon, or is not."""
    env, kind = env_of(name, horizon=2, clock=clock)
    model = CounterfactualPPO(
        "MlpPolicy", env, alternatives=kind, n_steps=2, gamma=0.5, gae_lambda=0.0, batch_size=2
    )
    critic: Any = model.policy.value_net
    torch.nn.init.zeros_(critic.weight)
    torch.nn.init.constant_(critic.bias, 3.0)
    env.seed(0)
    _, callback = model._setup_learn(100)
    model.collect_rollouts(env, callback, model.rollout_buffer, 2)
    rollout = model._rollout
    assert rollout is not None
    first, last = rollout.returns.reshape(2, -1).numpy()
    worth = 0.5 * 3.0 * env.view.rows_per_run  # no reward is above 0
    best = 0.0 if clock else worth
    assert (last < best).all()
    assert last.max() > best - 0.6
    assert (first < worth).all()
    assert first.max() > worth - 1.2


def test_returns_and_advantages_are_those_of_the_definition() -> None:
    """G = V̄ + δ, δ = γ λ (G' - V(o')), nothing across the ends; A = Q - V̄ (Schulman et al.)."""
    env, _ = env_of("flips")
    model = CounterfactualPPO(
        "MlpPolicy", env, alternatives="flips", n_steps=3, gamma=0.9, gae_lambda=0.8
    )
    rng = np.random.default_rng(0)
    steps = []
    for _ in range(3):
        probability = rng.uniform(0.1, 0.9, (RUNS, 3))
        old = torch.as_tensor(np.log(np.stack((1 - probability, probability), -1)))
        steps.append(
            _Step(
                torch.zeros((RUNS, env.observation_space.shape[0])),  # type: ignore[index]
                rng.integers(0, 2, (RUNS, 3)), old, rng.normal(size=(RUNS, 3, 2)),
                rng.normal(size=RUNS), rng.random(RUNS) < 0.3,
            )
        )  # fmt: skip
    rollout = model._credited(steps)
    for run_ in range(RUNS):
        ahead = None
        for place in (2, 1, 0):
            step = steps[place]
            mean = [
                (np.exp(step.old[run_, i].numpy()) * step.values[run_, i]).sum() for i in range(3)
            ]
            own = 0.0
            if ahead is not None and not step.dones[run_]:
                own = 0.9 * 0.8 * (ahead - step.follows[run_])
            ahead = np.mean(mean) + own
            row = place * RUNS + run_
            np.testing.assert_allclose(rollout.surplus[row], own, rtol=1e-5, atol=1e-7)
            np.testing.assert_allclose(rollout.returns[row], ahead, rtol=1e-5)
            for i in range(3):
                target = step.values[run_, i] - mean[i]
                np.testing.assert_allclose(rollout.advantages[row, i], target, rtol=1e-4, atol=1e-6)


SETTINGS: list[Any] = [
    ("counterfactual_ppo", {"memory": True}, {"error": "mismatch"}, {}),
    (
        "counterfactual_ppo",
        {"cost_weight": "random", "price_range": [0.003, 0.3]}, {"price_exponent": 0.5}, {},
    ),
    ("counterfactual_ppo", {}, {}, {"local": True}),
]  # fmt: skip


def test_another_unit_of_the_critic_changes_no_value() -> None:
    env, _ = env_of("all")
    model = CounterfactualPPO("MlpPolicy", env, seed=0)
    observation = torch.rand((RUNS, env.observation_space.shape[0]))  # type: ignore[index]
    before = model._critic(observation)
    model._rescale_critic(400.0)
    assert model.value_scale == pytest.approx(400.0)
    torch.testing.assert_close(model._critic(observation), before)
    model._n_updates = 1
    model._rescale_critic(4.0)
    assert 4.0 < model.value_scale < 400.0
    torch.testing.assert_close(model._critic(observation), before)


@pytest.mark.parametrize(("kind", "options", "training", "where"), SETTINGS)
def test_its_models_are_ordinary_ones(
    tmp_path: Path, kind: str, options: Any, training: Any, where: Any
) -> None:
    """Loaded without trust, and with Stable-Baselines3's own class; both decide alike."""
    options = {"filter": "tobit", "horizon": 20, **options}
    config = small_config(
        tmp_path, kind, environment={"id": ENV, "options": options, **where},
        training={"timesteps": 1024, "num_envs": 8, **training},
    )  # fmt: skip
    experiment = load_checked(Experiment, config)
    assert run.train(experiment, quiet=True)["finished"]
    model = Path(experiment.output) / "final_model.zip"
    priced = options | ({"cost_weight": 0.03} if "price_range" in options else {})
    task = fusion_gym.make_task(ENV, **priced)
    policy: Any = make_policy(f"model:{model}", task)
    plain = next(
        base for base in TABLE[kind].model.__mro__ if base.__module__.split(".")[0] != "fusion_gym"
    )
    assert type(policy.model) is plain
    loaded = plain.load(model, device="cpu")  # type: ignore[attr-defined]
    for name, weight in loaded.policy.state_dict().items():
        assert torch.equal(policy.model.policy.state_dict()[name], weight)
    results = run_episodes(task, policy, 4, 0)
    assert np.isfinite(results.mse).all()


def test_it_needs_an_environment_that_can_branch() -> None:
    plain = FusionSB3VecEnv(fusion_gym.make_task(ENV), 2)
    with pytest.raises(ConfigurationError, match="env = FusionSB3VecEnv is not allowed"):
        CounterfactualPPO("MlpPolicy", plain)


@pytest.mark.slow
def test_it_learns_what_ppo_does_not_see_yet(tmp_path: Path) -> None:
    """In 10,000 steps better than PPO after as many, and better than requests at random."""
    options = {"filter": "tobit", "random_start": True, "token_rate": 2.0, "cost_weight": 0.03}
    task = fusion_gym.make_task(ENV, **options, memory=True)
    returns = {}
    for kind in ("ppo", "counterfactual_ppo"):
        config = small_config(
            tmp_path, kind,
            environment={"id": ENV, "options": {**options, "memory": True}},
            algorithm={
                "name": kind, "n_steps": 32, "batch_size": 256, "n_epochs": 8, "initial_rate": 0.1
            },
            training={"timesteps": 10_000, "num_envs": 64, "error": "mismatch"},
            validation={"every": 10_000, "episodes": 4}, output=str(tmp_path / kind),
        )  # fmt: skip
        run.train(load_checked(Experiment, config), quiet=True)
        policy = make_policy(f"model:{tmp_path / kind / 'final_model.zip'}", task)
        returns[kind] = run_episodes(task, policy, 100, 0).returns.mean()
    chance = run_episodes(task, make_policy("random:rate=0.06", task), 100, 0).returns.mean()
    assert returns["counterfactual_ppo"] > max(chance, returns["ppo"]) + 1.0, (returns, chance)
