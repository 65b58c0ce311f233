"""Train two agents and compare them with rules under the same budget, in minutes.

    fusion-gym demo --output runs/demo --episodes 1000

One agent learns in LinearFusion and one in the Tobit oscillator. Each agent observes all new
measurements and the price of a token, with memory of unsent measurements. A table shows its cost at
seven prices and the cost of the best rule of ``scale_free_sweep``, with the same memory and on the
same episodes. Four lines at the end say what the agents save, also against the oscillator's paper.
"""

import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from fusion_gym.commands.command_line import OUTPUT_FOLDER, Episodes, Long, Steps
from fusion_gym.commands.compare import Compare, Point, run_all
from fusion_gym.commands.train import Train
from fusion_gym.envs.registration import make_task
from fusion_gym.output.progress import remark
from fusion_gym.training.config import Experiment, load_checked
from fusion_gym.training.run import holds_training
from fusion_gym.validation import ConfigurationError

CONFIGS = {"linear_fusion": "linear_fusion_front", "tobit_oscillator": "tobit_oscillator_front"}


@dataclass(frozen=True)
class Demo(Long):
    """Train two agents and compare them with rules under the same budget, in minutes."""

    output: Annotated[Path, OUTPUT_FOLDER] = Path("runs/demo")
    """Folder for agents, tables and figures."""
    episodes: Episodes = 1000
    """Episodes of each policy."""
    timesteps: Steps = None
    """Steps of each training, instead of the steps in the configs."""
    resume: bool = False
    """Continue the trainings in the folder; resume only your own, since they contain pickles."""

    def run(self) -> None:
        """Train side by side, and compare in one environment after the other."""
        first, *others = (self._training(name) for name in CONFIGS)
        with ThreadPoolExecutor() as pool:
            beside = [pool.submit(self._train_apart, training) for training in others]
            first.run()
            remark("waiting for the training beside this one")
        for training in beside:
            training.result()
        savings = []
        for name in CONFIGS:
            folder = self.output / name
            agent = folder / "agent"
            policy = f"model:{agent / 'calibrated_model.zip'}"
            points = Compare(
                config=str(agent / "config.yaml"),
                sweep="scale_free_sweep",
                prices=7,
                episodes=self.episodes,
                output=folder / "comparison",
            ).points(policy)
            savings.append(f"{-np.mean([point.at_price.relative for point in points]):.1%}")
        paper = self._saving(agent / "config.yaml", points)
        lines = {
            "trained": f"{len(CONFIGS)} agents, calibrated: {', '.join(CONFIGS)}",
            "saved against the best rule at each price": ", ".join(savings),
            f"saved against the paper's trigger ({name})": f"{paper:.1%}",
            "pictures": self.output / "*" / "comparison" / "pareto.png",
        }
        print("\n".join(f"{title:50} {text}" for title, text in lines.items()))

    def _saving(self, config: Path, points: Sequence[Point]) -> float:
        """Return the share of the tuned trigger's cost that the oscillator's agent saves."""
        world = load_checked(Experiment, str(config)).environment
        task = make_task(world.id, **world.options)
        scales = [f"dynamic_event:scale={scale:.3g}" for scale in np.geomspace(0.1, 100.0, 24)]
        triggers = run_all(task, scales, self.episodes, 0, "the paper's trigger").values()
        costs = [p.at_price.cost + p.at_price.difference.mean for p in points]
        least = [min(float(t.cost(p.at_price.price).mean()) for t in triggers) for p in points]
        return float(np.mean(1.0 - np.divide(costs, least)))

    def _training(self, name: str) -> Train:
        agent = self.output / name / "agent"
        resume = self.resume and holds_training(agent)
        return Train(
            config=CONFIGS[name], timesteps=self.timesteps, output=str(agent), resume=resume
        )

    def _train_apart(self, training: Train) -> None:
        """Train in a process of its own, whose output is in a file beside the agent."""
        words = [f"--config={training.config}", f"--output={training.output}"]
        words += [] if training.timesteps is None else [f"--timesteps={training.timesteps}"]
        words += ["--resume"] if training.resume else []
        file = Path(f"{training.output}.log")
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("w", encoding="utf-8") as log:
            command = [sys.executable, "-m", "fusion_gym.commands", "train", *words]
            done = subprocess.run(command, stdout=log, stderr=log, check=False)
        if done.returncode:
            raise ConfigurationError(f"the training of {training.config} failed: see {file}")
