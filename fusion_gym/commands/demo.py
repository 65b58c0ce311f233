"""Train two agents and compare them with rules under the same budget, in minutes.

    fusion-gym demo --output runs/demo --episodes 500

One agent learns in LinearFusion and one in the Tobit oscillator. Each agent observes all new
measurements and the price of a token, with memory of unsent measurements. A table shows the costs
at seven prices of the agent and of rules with the same memory, on the same episodes. Four lines at
the end say what the agents save, also against the oscillator's paper.
"""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from fusion_gym.commands.command_line import OUTPUT_FOLDER, Episodes, Long, Steps
from fusion_gym.commands.compare import Compare, short_text
from fusion_gym.commands.train import Train
from fusion_gym.output.progress import remark
from fusion_gym.training.run import holds_training
from fusion_gym.validation import ConfigurationError

# Rules whose parameters have no unit, for any environment.
RULES = (
    "innovation_threshold:whitened=true,at_most=1",
    "kullback_leibler",
    "value_of_information",
    "value_of_information:at_most=1",
    "paced",
)
TRIGGERS = {"tobit_oscillator": ("dynamic_event:scale={value}",)}
CONFIGS = {"linear_fusion": "linear_fusion_front", "tobit_oscillator": "tobit_oscillator_front"}


@dataclass(frozen=True)
class Demo(Long):
    """Train two agents and compare them with rules under the same budget, in minutes."""

    output: Annotated[Path, OUTPUT_FOLDER] = Path("runs/demo")
    """Folder for agents, tables and figures."""
    episodes: Episodes = 500
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
        savings, paper = [], 0.0
        for name in CONFIGS:
            folder = self.output / name
            agent = f"model:{folder / 'agent' / 'calibrated_model.zip'}"
            trigger = TRIGGERS.get(name, ())
            costs = Compare(
                config=str(folder / "agent" / "config.yaml"),
                policies=((agent, *RULES, *trigger),),
                prices=7,
                episodes=self.episodes,
                output=folder / "comparison",
            ).costs()
            rows = [{text: own for text, own in row.items() if own} for row in costs.values()]
            own = [row[short_text(agent)] for row in rows]
            savings.append(f"{-np.mean([item.relative.mean for item in own]):.1%}")
            for text in trigger:
                least = [row[text].mean for row in rows]
                paper = float(np.mean([1.0 - a.mean / b for a, b in zip(own, least, strict=True)]))
        lines = {
            "trained": f"{len(CONFIGS)} agents, calibrated: {', '.join(CONFIGS)}",
            "saved against the best rule at each price": ", ".join(savings),
            f"saved against the paper's trigger ({name})": f"{paper:.1%}",
            "pictures": self.output / "*" / "comparison" / "pareto.png",
        }
        print("\n".join(f"{title:50} {text}" for title, text in lines.items()))

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
