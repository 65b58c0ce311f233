"""When must an agent of a Gymnasium environment observe? Three answers, each in minutes.

python examples/any_environment.py cart-pole
python examples/any_environment.py lunar-lander
python examples/any_environment.py joint
"""

from __future__ import annotations

import types
from pathlib import Path

import gymnasium
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import fusion_gym
from fusion_gym.evaluation import run_episodes
from fusion_gym.evaluation.rule_search import RuleSearch, search_rule
from fusion_gym.wrappers import CostlyObservation

ID, FOLDER = "fusion_gym/GymnasiumEnvironment-v1", Path("runs/any_environment")
SENSORS, PRICE, HORIZON = [[0, 1], [2, 3]], 0.2, 200  # of the shaken CartPole


class Shaken(gymnasium.ActionWrapper):
    """Replace one action in five by a random one."""

    def action(self, action):
        """Draw from the environment's own generator, as often for each action."""
        chance, drawn = self.np_random.random(), self.np_random.integers(2)
        return drawn if chance < 0.2 else action


gymnasium.register("Shaken/CartPole-v1", lambda **own: Shaken(gymnasium.make("CartPole-v1", **own)))


class Periods:
    """Request each sensor with a period of its own."""

    knowledge = "clock"

    def __init__(self, periods) -> None:
        self.periods = np.array(periods)[:, None]

    def reset(self, runs, seed=0):
        """Keep nothing."""

    def __call__(self, signals):
        """Requests (sensors, N)."""
        phases = np.arange(len(self.periods))[:, None] * self.periods // len(self.periods)
        return (signals["step"] + phases) % self.periods == 0


def heuristic(observations):
    """Gymnasium's controller of LunarLander, for observations (N, 8)."""
    from gymnasium.envs.box2d import lunar_lander

    lander = types.SimpleNamespace(unwrapped=types.SimpleNamespace(continuous=False))
    return np.array([lunar_lander.heuristic(lander, seen) for seen in observations])


def loss(task, policy, episodes, seed):
    """Lost reward and price of the packets of each episode."""
    results = run_episodes(task, policy, episodes, seed)
    return task.horizon * results.cost(float(task.options.cost_weight))


def best_periods(task, episodes):
    """Improve one period after another, from the best common one."""
    choices = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64)
    cost = {}

    def measure(periods):
        if periods not in cost:
            cost[periods] = loss(task, Periods(periods), episodes, 5_000).mean()
        return cost[periods]

    best = min(((choice,) * task.sensors for choice in choices), key=measure)
    for sensor in [*range(task.sensors)] * 2:
        best = min(((*best[:sensor], c, *best[sensor + 1 :]) for c in choices), key=measure)
    return best


def opponents(task, episodes):
    """Policies by name: a period and a threshold for each sensor, and the value of information."""
    periods, price = best_periods(task, episodes), float(task.options.cost_weight)
    policies = {"always": "always", f"periods {'/'.join(map(str, periods))}": Periods(periods)}
    for rule in ("innovation_threshold", "value_of_information"):
        size = {"generations": 6, "population": 6, "episodes": (max(episodes // 4, 1), episodes)}
        (text,) = search_rule(RuleSearch(task, (price,), rule, **size)).policies
        policies[text] = text
    return policies


def compare(task, policies, episodes):
    """Print return, packets and return less their price, of fresh episodes."""
    print(f"{'policy':82s}  return  packets  less their price")
    for name, policy in policies.items():
        made = fusion_gym.make_policy(policy, task) if isinstance(policy, str) else policy
        results = run_episodes(task, made, episodes, 0)
        report(
            name,
            task.horizon * (task.options.best_reward - results.control_cost),
            task.horizon * results.tokens,
            float(task.options.cost_weight),
        )


def report(name, returns, packets, price):
    """Print a row of means."""
    net = returns - price * packets
    half = 1.96 * net.std() / len(net) ** 0.5
    print(f"{name:82s} {returns.mean():7.1f} {packets.mean():8.1f} {net.mean():9.1f} ± {half:.1f}")


def agent(steps):
    """Train PPO on CartPole-v1, and return its file."""
    file = FOLDER / f"cart_pole_{steps}.zip"
    if not file.exists():
        env = make_vec_env("CartPole-v1", 8, seed=0)
        settings = {"n_steps": 256, "batch_size": 256, "n_epochs": 10, "gamma": 0.98}
        model = PPO("MlpPolicy", env, 1e-3, gae_lambda=0.8, seed=0, device="cpu", **settings)
        model.learn(steps).save(file)
    return f"model:{file}"


def shaken(predictor, steps):
    """The shaken CartPole under a saved agent."""
    return fusion_gym.make_task(
        ID, env_id="Shaken/CartPole-v1", controller=agent(steps), sensor_indices=SENSORS,
        predictor=predictor, horizon=HORIZON, cost_weight=PRICE,
    )  # fmt: skip


def cart_pole(steps: int = 40_000, episodes: int = 200, timesteps: int = 200_000) -> None:
    """Compare rules and PPO on the estimate of an agent of Stable-Baselines3."""
    quiet = fusion_gym.make_task(
        ID, controller=agent(steps), predictor="linear", horizon=500, cost_weight=0.0
    )
    print("CartPole-v1, 500 steps, linear predictor")
    compare(
        quiet, {rule: rule for rule in ("always", "innovation_threshold:threshold=0.3")}, episodes
    )
    for predictor in ("hold", "linear"):
        task = shaken(predictor, steps)
        explained = np.round(task.plant.system.predictor.explained_variance, 2)
        print(f"one action in five is random, predictor {predictor!r}, R² {explained}")
        policies = opponents(task, episodes // 4)
        policies["PPO"] = learn(task, predictor, timesteps)
        compare(task, policies, episodes)


def learn(task, name, timesteps):
    """Train PPO to transmit."""
    experiment = {
        "environment": {"id": ID, "options": {**task.settings}},
        "algorithm": {
            "name": "ppo",
            "learning_rate": 0.002,
            "learning_rate_end": 1e-5,
            "n_steps": 32,
            "batch_size": 2048,
            "gamma": 0.97,
            "initial_rate": 0.1,
        },
        "training": {"timesteps": timesteps, "num_envs": 64},
        "validation": {"every": timesteps // 4, "episodes": 32},
        "output": str(FOLDER / name),
    }
    fusion_gym.train(fusion_gym.Experiment.model_validate(experiment))
    return f"model:{FOLDER / name}/best_model.zip"


def lunar_lander(episodes: int = 40) -> None:
    """Compare rules on the estimate of Gymnasium's controller of LunarLander."""
    task = fusion_gym.make_task(
        ID, env_id="LunarLander-v3", controller=heuristic, predictor="linear", horizon=400,
        sensor_indices=[[0, 1], [2, 3], [4, 5], [6, 7]], best_reward=100.0, cost_weight=0.2,
    )  # fmt: skip
    compare(task, opponents(task, episodes // 4), episodes)


def joint(timesteps: int = 200_000, steps: int = 40_000, episodes: int = 200) -> None:
    """Train an agent that acts and observes, and compare it with an agent that only acts."""

    def make():
        env = gymnasium.make("Shaken/CartPole-v1", max_episode_steps=HORIZON)
        return CostlyObservation(env, SENSORS, PRICE)

    settings = {"n_steps": 128, "batch_size": 256, "n_epochs": 10, "gamma": 0.99}
    model = PPO("MlpPolicy", make_vec_env(make, 8, seed=0), 1e-3, seed=0, device="cpu", **settings)
    model.learn(timesteps)
    env, rows = make(), []
    for episode in range(episodes):
        seen, _ = env.reset(seed=episode)
        returns, packets, over = 0.0, 0.0, False
        while not over:
            action, _ = model.predict(seen, deterministic=True)
            seen, reward, *ends, info = env.step(action)
            packets, over = packets + info["cost"], any(ends)
            returns += reward + PRICE * info["cost"]
        rows.append((returns, packets))
    task = shaken("hold", steps)
    compare(task, opponents(task, episodes // 4), episodes)
    report("PPO that acts and requests", *np.array(rows).T, PRICE)


if __name__ == "__main__":
    torch.set_num_threads(1)
    FOLDER.mkdir(parents=True, exist_ok=True)
    commands = {"cart-pole": cart_pole, "lunar-lander": lunar_lander, "joint": joint}
    tyro.extras.subcommand_cli_from_dict(commands)
