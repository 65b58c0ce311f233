"""Diagnostics of a training besides its loss: traffic, entropy and validation at each price.

``docs/learning.md`` describes each line in a healthy training and the causes of deviations.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from fusion_gym.arrays import Array
from fusion_gym.core.scale import sustained_tokens
from fusion_gym.core.task import Task
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.evaluation.episodes import run_priced
from fusion_gym.evaluation.rule_search import class_of, search_of_class
from fusion_gym.policies.card import ModelView
from fusion_gym.policies.model import ModelPolicy

PRICES = 5  # of a validation over a range, evenly spaced on a logarithmic scale


class Callback(BaseCallback):
    """A callback between rollouts, with access to the training's environment."""

    @property
    def environment(self) -> FusionSB3VecEnv:
        """The environment without wrappers."""
        env = self.training_env.unwrapped
        assert isinstance(env, FusionSB3VecEnv)
        return env

    def _on_step(self) -> bool:
        return True


class Traffic(Callback):
    """Logs the rates of requests and grants in a rollout, and the policy's entropy per sensor.

    Rates are per sensor and step. The entropy, in nats, is from the update before the rollout, for
    algorithms that report it.
    """

    def _on_rollout_start(self) -> None:
        env = self.environment
        self._mark = env.requests, env.totals[1]
        lost = self.logger.name_to_value.get("train/entropy_loss")
        if lost is not None:
            deciding = 1 if env.num_envs > env.runs else env.task.sensors
            self.logger.record("train/entropy_per_sensor", -lost / deciding)

    def _on_rollout_end(self) -> None:
        env = self.environment
        (requested, granted), steps = self._mark
        chances = env.task.sensors * (env.totals[1] - steps)
        if chances > 0:
            self.logger.record_mean("rollout/requested", (env.requests[0] - requested) / chances)
            self.logger.record_mean("rollout/granted", (env.requests[1] - granted) / chances)


class PriceRecord(NamedTuple):
    """An agent at a price of a token: means per step of its likeliest and of drawn actions."""

    price: float
    cost: float
    tokens: float
    mse: float
    rate: float
    drawn_cost: float
    drawn_tokens: float
    drawn_mse: float


def validation_prices(task: Task) -> tuple[float, ...]:
    """Return the prices of a validation: of a drawn price the range, else the task's own."""
    price = task.reward.price
    if price.fixed is not None or price.span is None:
        return (price.middle,)
    return tuple(np.geomspace(*price.span, PRICES).tolist())


def run_at_prices(
    model: BaseAlgorithm, task: Task, local: bool, prices: Sequence[float], episodes: int, seed: int
) -> list[PriceRecord]:
    """Run the model's likeliest and drawn actions at each price, on the same episodes."""
    count = max(1, episodes // len(prices))
    each, seeds = np.repeat(prices, count), seed + np.tile(np.arange(count), len(prices))
    columns: list[Array] = [np.array(prices)]
    for deterministic in (True, False):
        policy = ModelPolicy(model, task, deterministic, trained=ModelView(local=local))
        means = run_priced(task, policy, seeds, each)
        columns += [means.cost(each), means.tokens, means.mse]
        columns += [means.rate.mean(-1)] if deterministic else []
    rows = zip(
        *(column.reshape(len(prices), -1).mean(1).tolist() for column in columns), strict=True
    )
    return [PriceRecord(*row) for row in rows]


def threshold_costs(task: Task, local: bool, prices: Sequence[float]) -> Array:
    """Return the cost of the best single threshold of the class at each price; 1 at one price."""
    if len(prices) == 1:
        return np.ones(1)
    search = search_of_class(class_of(task, local), task, prices, generations=1, episodes=(16, 16))
    return search.start_costs(search.start)


def warn_of_silence(records: Sequence[PriceRecord]) -> None:
    """Warn where the likeliest action spends less than half of the tokens of drawn actions."""
    silent = [row for row in records if row.tokens < 0.5 * row.drawn_tokens]
    if silent:
        row = min(silent, key=lambda row: row.tokens / row.drawn_tokens)
        warnings.warn(
            f"at {len(silent)} of {len(records)} prices the likeliest action spends less than half "
            f"of the tokens of drawn actions (at {row.price:.4g}: {row.tokens:.3g} of "
            f"{row.drawn_tokens:.3g} a step): fusion-gym calibrate mends it",
            stacklevel=2,
        )


def warn_of_unused_tokens(task: Task, tokens: float) -> None:
    """Warn if an agent at its lowest price spends less than half of the sustained tokens a step."""
    sustained = sustained_tokens(task)
    share = tokens / sustained if sustained else 1.0
    if share < 0.5 and not task.network.bucket.unlimited:
        warnings.warn(
            f"at its lowest price the agent spends {share:.0%} of the tokens that the bucket "
            "sustains: a lower price, or a reward_scale above the present "
            f"{task.settings.get('reward_scale')}, lets it use more",
            stacklevel=2,
        )
