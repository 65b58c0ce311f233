"""Train agents in the solved case and print what they cost above the optimum.

    python -m agents.solved --config configs/remote_estimation_ppo.yaml --seeds 0 1 2

Trainings go into ``runs/solved``; a finished one is not repeated, an interrupted one is gone on
with. Costs are compared on the same test seeds, paired.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from agents import tables
from agents.config import Experiment, load_experiment
from agents.evaluate import write
from agents.train import train
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.make import make_policy
from fusion_gym.validation import ConfigurationError


def trained(experiment: Experiment, seed: int, folder: Path) -> Path:
    """The final model of a training seed, trained if it is not there.

    Raises:
        KeyboardInterrupt: the training was interrupted.
    """
    plain = experiment.model_dump()
    plain["training"]["seed"] = seed
    plain["output"] = str(folder / f"{experiment.algorithm.name}_{seed}")
    output = Path(plain["output"])
    summary = output / "summary.json"
    if not (summary.exists() and json.loads(summary.read_text())["finished"]):
        found = train(Experiment.model_validate(plain), resume=(output / "config.yaml").exists())
        if not found["finished"]:
            raise KeyboardInterrupt
    return output / "final_model.zip"


def excess(agent: EpisodeResults, best: EpisodeResults) -> dict[str, float]:
    """The agent's cost above the optimum's, as a share of it, with its paired 95 % interval."""
    optimum = -float(best.returns.mean())
    return {
        name: value / optimum
        for name, value in mean_interval(best.returns - agent.returns)._asdict().items()
    }


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    parser = argparse.ArgumentParser(
        prog="python -m agents.solved",
        description="What agents cost above the optimum, where it is known.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--config", default="configs/remote_estimation_ppo.yaml")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the trainings")
    parser.add_argument("--episodes", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0, help="of the first test episode")
    parser.add_argument("--output", type=Path, default=Path("runs/solved"))
    given = parser.parse_args()
    try:
        experiment = load_experiment(given.config)
        chosen = experiment.environment
        task = make_task(chosen.id, **chosen.options)
        best = run_episodes(task, make_policy("optimal", task), given.episodes, given.seed)
        table = Table(title=f"{given.config}: {given.episodes} episodes", box=box.SIMPLE_HEAD)
        for column in ("policy", "cost of an episode", "rate", "above the optimum [95 %]"):
            table.add_column(column, justify="left" if column == "policy" else "right")
        report: dict[str, Any] = {"config": given.config, "agents": {}}
        table.add_row("optimal", f"{-best.returns.mean():.4f}", f"{best.rate.mean():.4f}", "")
        for seed in given.seeds:
            model = trained(experiment, seed, given.output)
            policy = make_policy(f"model:{model}", task)
            agent = run_episodes(task, policy, given.episodes, given.seed)
            found = excess(agent, best)
            report["agents"][str(seed)] = found
            write(given.output / f"{experiment.algorithm.name}.json", report)
            table.add_row(
                f"{experiment.algorithm.name}, training seed {seed}",
                f"{-agent.returns.mean():.4f}",
                f"{agent.rate.mean():.4f}",
                f"{found['mean']:+.2%} [{found['low']:+.2%}, {found['high']:+.2%}]",
            )
        tables.console().print(table)
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
