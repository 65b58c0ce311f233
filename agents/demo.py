"""The project's main job, end to end: baselines, a trained agent, and a fair comparison.

    python -m agents.demo [--output runs/demo] [--episodes 1000] [--fresh]

In the benchmark setting and in the paper's it sweeps the analytic policies, trains PPO, compares
it on the same seeds with the lower envelope of all baselines, and draws the Pareto front and one
episode. A finished or interrupted training in the output folder is gone on with, not repeated.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from agents import figures
from agents.compare import compare, run_all
from agents.config import Experiment, Sweep, load_experiment, load_sweep
from agents.train import train
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import record_episode
from fusion_gym.policies.make import make_policy
from fusion_gym.validation import ConfigurationError


@dataclass(frozen=True)
class Setting:
    """A named setting of the demo: the config that trains in it, and its title."""

    name: str
    config: str
    title: str


SETTINGS = (
    Setting(
        "benchmark",
        "configs/tobit_oscillator_ppo.yaml",
        "benchmark setting (Tobit filter, random start, 2 tokens a step)",
    ),
    Setting(
        "paper",
        "configs/tobit_oscillator_paper_ppo.yaml",
        "paper's setting (its filter and bucket)",
    ),
)


def demonstrate(
    setting: Setting, experiment: Experiment, sweep: Sweep, arguments: argparse.Namespace
) -> bool:
    """One setting from baselines to figures; false if its training was interrupted."""
    folder: Path = arguments.output / setting.name
    task = make_task(experiment.environment.id, **experiment.environment.options)
    print(f"\n{setting.title}")
    baselines = run_all(task, sweep.policies, arguments.episodes, arguments.seed, "baselines")
    plain = experiment.model_dump() | {"output": str(folder / "agent")}
    training = Experiment.model_validate(plain)
    summary = train(training, resume=(folder / "agent" / "config.yaml").exists())
    if not summary["finished"]:
        return False
    agent = f"model:{folder / 'agent' / 'best_model.zip'}"
    learned = run_all(task, [agent], arguments.episodes, arguments.seed, "agent")[agent]
    compare(
        experiment.environment.id,
        task,
        setting.title,
        baselines,
        sweep,
        agent,
        learned,
        arguments.seed,
        folder,
    )
    for name, text in (("agent", agent), ("dynamic_event", "dynamic_event")):
        trajectory = record_episode(task, make_policy(text, task), arguments.seed)
        figures.episode(
            folder / f"episode_{name}.png", f"{setting.name}: {name}", trajectory,
            task.bucket.capacity,
        )  # fmt: skip
    return True


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="python -m agents.demo",
        description="Baselines, a trained agent, and a fair comparison.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    result.add_argument("--output", type=Path, default=Path("runs/demo"))
    result.add_argument("--episodes", type=int, default=1000)
    result.add_argument("--seed", type=int, default=0, help="seed of the first test episode")
    result.add_argument("--sweep", default="configs/tobit_oscillator_sweep.yaml")
    result.add_argument("--timesteps", type=int, help="of each training, instead of the configs'")
    result.add_argument("--fresh", action="store_true", help="remove earlier results first")
    return result


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    arguments = parser().parse_args()
    began = time.perf_counter()
    try:
        for setting in SETTINGS if arguments.fresh else ():
            shutil.rmtree(arguments.output / setting.name, ignore_errors=True)
        sweep = load_sweep(arguments.sweep)
        for setting in SETTINGS:
            experiment = load_experiment(setting.config)
            if arguments.timesteps is not None:
                training = experiment.training.model_copy(update={"timesteps": arguments.timesteps})
                experiment = experiment.model_copy(update={"training": training})
            if not demonstrate(setting, experiment, sweep, arguments):
                sys.exit(130)
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: run the same command again to go on")
    print(f"\nfigures, tables and models are in {arguments.output}; "
          f"{time.perf_counter() - began:.0f} s")  # fmt: skip


if __name__ == "__main__":
    main()
