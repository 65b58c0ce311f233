"""Diagnostics of a training besides its loss: traffic, entropy and validation at each price.

``docs/learning.md`` describes each line in a healthy training and the causes of deviations.
"""

import warnings
from typing import Any

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.scale import sustained_tokens
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.training.callback import Callback

PARTS = 5  # of the range of prices, equal on a logarithmic scale


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


def prices_of(task: Task, episodes: int, seed: int) -> Array:
    """Return the prices (E,) of a token in the episodes of these seeds."""
    fixed = task.reward.price.fixed
    if fixed is not None:
        return np.full(episodes, fixed)
    return EpisodeBatch.seeded(task, episodes, seed).price


def by_price(task: Task, prices: Array, results: EpisodeResults) -> list[dict[str, Any]]:
    """Return rate and MSE of the episodes in each non-empty part of the range of prices."""
    span = task.reward.price.span
    if task.reward.price.fixed is not None or span is None:
        return []
    ends = np.geomspace(*span, PARTS + 1)
    part = np.clip(np.searchsorted(ends, prices, side="right") - 1, 0, PARTS - 1)
    return [
        {
            "low": float(ends[place]),
            "high": float(ends[place + 1]),
            "episodes": int(selection.sum()),
            "rate": float(results.rate[selection].mean()),
            "mse": float(results.mse[selection].mean()),
        }
        for place in range(PARTS)
        if (selection := part == place).any()
    ]


def warn_of_unused_tokens(task: Task, results: EpisodeResults) -> None:
    """Warn if an agent spends less than half of its tokens at its lowest price."""
    sustained = sustained_tokens(task)
    share = float(results.tokens.mean()) / sustained if sustained else 1.0
    if share < 0.5 and not task.bucket.unlimited:
        warnings.warn(
            f"at its lowest price the agent spends {share:.0%} of the tokens that the bucket "
            "sustains: a lower price, or a reward_scale above the present "
            f"{task.settings.get('reward_scale')}, lets it use more",
            stacklevel=2,
        )
