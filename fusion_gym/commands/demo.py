"""Train two agents and compare them with rules under the same budget, in minutes.

    fusion-gym demo --output runs/demo --episodes 1000

One agent learns in LinearFusion and one in the Tobit oscillator. Each agent observes all new
measurements and the price of a token, with memory of unsent measurements. A table shows its cost at
seven prices and the cost of the best rule of ``scale_free_sweep``, with the same memory and on the
same episodes.
"""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fusion_gym.commands.command_line import Long
from fusion_gym.commands.compare import Compare
from fusion_gym.commands.options import OUTPUT_FOLDER, Episodes, Steps
from fusion_gym.commands.train import Train
from fusion_gym.output.progress import remark
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
        for name in CONFIGS:
            folder = self.output / name
            agent = folder / "agent"
            Compare(
                config=str(agent / "config.yaml"),
                sweep="scale_free_sweep",
                policy=f"model:{agent / 'calibrated_model.zip'}",
                prices=7,
                episodes=self.episodes,
                output=folder / "comparison",
            ).run()

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
