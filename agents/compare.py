"""Compare one policy with the lower envelope of swept baselines, at the policy's own rate.

    python -m agents.compare --config configs/biased_oscillator_ppo.yaml \\
        --sweep configs/biased_sweep.yaml \\
        --policy model:runs/biased_oscillator_ppo/best_model.zip --output runs/comparison

All policies run on the same seeds. Into the output folder go ``evaluation.json`` (every policy),
``comparison.json`` (the verdict) and ``pareto.png``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fusion_gym.envs.registration import make_task
from fusion_gym.policies.registry import make_policy

from .command_line import Command, start
from .input.options import Episodes, OutputFolder, Seed
from .suite.comparison import compare, run_all
from .suite.sweep import Sweep
from .training.checked import load
from .training.config import Experiment


@dataclass(frozen=True)
class Compare(Command):
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
    trust: bool = False
    """Load model:PATH with Stable-Baselines3's loader, which runs any code that the file holds."""

    def run(self) -> None:
        """Run all policies on the same seeds; write, print and draw the comparison."""
        chosen, sweep = load(Experiment, self.config).environment, load(Sweep, self.sweep, "sweep")
        task = make_task(chosen.id, **chosen.options)
        make_policy(self.policy, task, trust=self.trust)
        baselines = run_all(
            task, sweep.policies, self.episodes, self.seed, "baselines", trust=self.trust
        )
        compare(chosen.id, task, sweep, baselines, self.policy, self.seed, self.output, self.trust)


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Compare)


if __name__ == "__main__":
    main()
