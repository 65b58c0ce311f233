"""Compare one policy with the lower envelope of swept baselines, at the policy's own rate.

    fusion-gym compare --config configs/biased_oscillator_ppo.yaml \\
        --sweep configs/biased_sweep.yaml \\
        --policy model:runs/biased_oscillator_ppo/best_model.zip --output runs/comparison

An agent that sees the price of a token is asked at as many prices as ``--prices`` says: its whole
front. All policies run on the same seeds. Into the output folder go ``evaluation.json`` (every
policy), ``comparison.json`` (the verdict) and ``pareto.png``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.policies.registry import make_policy, policy_names
from fusion_gym.validation import refusal

from .command_line import Long
from .input.options import Episodes, OutputFolder, Seed, Whole
from .output.progress import writing
from .suite.comparison import compare, run_all
from .suite.sweep import Sweep
from .training.checked import load_checked
from .training.config import Experiment


@dataclass(frozen=True)
class Compare(Long):
    """Compare one policy with the lower envelope of swept baselines, at the policy's own rate."""

    config: str
    """A training's YAML, or the name of a shipped one: its environment."""
    sweep: str
    """The baselines' YAML, or the name of a shipped one."""
    policy: str
    """The policy, for example model:PATH."""
    output: Annotated[Path, OutputFolder()]
    """Folder for the results."""
    episodes: Episodes = 1000
    """Episodes of each policy."""
    seed: Seed = 0
    """Seed of the first episode."""
    prices: Annotated[int | None, Whole(2, 1000)] = None
    """Ask an agent that sees the price at as many, over the config's price_range."""

    keeps = False

    def run(self) -> None:
        """Run all policies on the same seeds; write, print and draw the comparison."""
        world, sweep = (
            load_checked(Experiment, self.config).environment,
            load_checked(Sweep, self.sweep, "sweep"),
        )
        task = make_task(world.id, **world.options)
        requested = self.policies_of(task)
        for policy in requested:
            make_policy(policy, task)
        writing(("evaluation, comparison and figure", self.output))
        baselines = run_all(task, sweep.policies, self.episodes, self.seed, "baselines")
        compare(world.id, task, sweep, baselines, requested, self.seed, self.output)

    def policies_of(self, task: Task) -> list[str]:
        """The policy, or the policy at each of the prices.

        Raises:
            ConfigurationError: prices, but none that is drawn, or a policy that is no agent.
        """
        if self.prices is None:
            return [self.policy]
        span = task.reward.price.span
        if span is None:
            raise refusal(
                "prices", self.prices, "left out where the config has no price_range, as here"
            )
        if self.policy.partition(":")[0] not in policy_names("agent"):
            raise refusal(
                "prices", self.prices, f"left out with policy = {self.policy!r}, which is no agent"
            )
        low, high = (repr(float(end)) for end in span)  # to the last digit: it knows no others
        inner = [f"{price:.4g}" for price in np.geomspace(*span, self.prices)[1:-1]]
        return [f"{self.policy},price={price}" for price in (low, *inner, high)]
