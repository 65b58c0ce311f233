"""The project's main job, end to end: baselines, a trained agent, and a fair comparison.

    python -m agents.demo [--output runs/demo] [--episodes 1000] [--fresh]

In the benchmark setting and in the paper's it sweeps the analytic policies, trains PPO, compares
it on the same seeds with the lower envelope of all baselines, and draws the Pareto front and one
episode. A finished or interrupted training in the output folder is gone on with, not repeated.
"""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import record_episode
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from .command_line import Command, start
from .input.options import Episodes, OutputFolder, Seed, Steps
from .output import figures
from .suite.comparison import compare, run_all
from .suite.sweep import Sweep
from .training.checked import load
from .training.config import Experiment
from .training.run import holds_training, train


@dataclass(frozen=True)
class Setting:
    """A named setting of the demo: the config that trains in it, and its title."""

    name: str
    config: str
    title: str


SETTINGS = (
    Setting(
        "benchmark",
        "tobit_oscillator_ppo",
        "benchmark setting (Tobit filter, random start, 2 tokens a step)",
    ),
    Setting(
        "paper",
        "tobit_oscillator_paper_ppo",
        "paper's setting (its filter and bucket)",
    ),
)


@dataclass(frozen=True)
class Demo(Command):
    """Baselines, a trained agent, and a fair comparison."""

    output: Annotated[Path, OutputFolder()] = Path("runs/demo")
    """Folder for the results."""
    episodes: Episodes = 1000
    """Test episodes of each policy."""
    seed: Seed = 0
    """Seed of the first test episode."""
    sweep: str = "tobit_oscillator_sweep"
    """The baselines' YAML, or the name of a shipped one."""
    timesteps: Steps = None
    """Steps of each training, instead of the configs'."""
    fresh: bool = False
    """Remove earlier results first."""

    def run(self) -> None:
        """Both settings from baselines to figures."""
        began = time.perf_counter()
        sweep = load(Sweep, self.sweep, "sweep")
        for setting in SETTINGS if self.fresh else ():
            remove(self.output / setting.name)
        for setting in SETTINGS:
            if not demonstrate(setting, load(Experiment, setting.config), sweep, self):
                raise KeyboardInterrupt
        seconds = time.perf_counter() - began
        print(f"\nfigures, tables and models are in {self.output}; {seconds:.0f} s")

    def interrupted(self) -> str:
        """Nothing is lost."""
        return "interrupted: run the same command again to go on"


def remove(folder: Path) -> None:
    """Remove what an earlier demo left in a folder, and nothing else.

    Raises:
        ConfigurationError: the folder holds something else.
    """
    if not folder.exists():
        return
    if any(folder.iterdir()) and not holds_training(folder / "agent"):
        raise ConfigurationError(
            f"fresh = True is not allowed: {str(folder)!r} holds no results of a demo, and is kept"
        )
    shutil.rmtree(folder)


def demonstrate(setting: Setting, experiment: Experiment, sweep: Sweep, given: Demo) -> bool:
    """One setting from baselines to figures; false if its training was interrupted."""
    folder = given.output / setting.name
    task = make_task(experiment.environment.id, **experiment.environment.options)
    print(f"\n{setting.title}")
    baselines = run_all(task, sweep.policies, given.episodes, given.seed, "baselines")
    training = experiment.changed(folder / "agent", timesteps=given.timesteps)
    if not train(training, resume=holds_training(folder / "agent"))["finished"]:
        return False
    agent = f"model:{folder / 'agent' / 'best_model.zip'}"
    names = (experiment.environment.id, setting.title)
    compare(names, task, sweep, baselines, agent, given.seed, folder)
    for name, text in (("agent", agent), ("dynamic_event", "dynamic_event")):
        trajectory = record_episode(task, make_policy(text, task), given.seed)
        figures.episode(
            folder / f"episode_{name}.png", f"{setting.name}: {name}", trajectory,
            task.bucket.capacity,
        )  # fmt: skip
    return True


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Demo)


if __name__ == "__main__":
    main()
