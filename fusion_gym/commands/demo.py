"""Train two agents and compare them with rules under the same budget, in minutes.

    fusion-gym demo --output runs/demo --episodes 1000

One agent learns in LinearFusion and one in the Tobit oscillator. Each agent observes all new
measurements and the price of a token, with memory of unsent measurements. A table shows its cost at
seven prices and the cost of the best rule of ``scale_free_sweep``, with the same memory and on the
same episodes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fusion_gym.commands.command_line import Long
from fusion_gym.commands.compare import Compare
from fusion_gym.commands.options import OUTPUT_FOLDER, Episodes, Steps
from fusion_gym.commands.train import Train
from fusion_gym.training.run import holds_training

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
        """Train and compare in one environment after the other."""
        for name, config in CONFIGS.items():
            folder = self.output / name
            agent = folder / "agent"
            Train(
                config=config,
                timesteps=self.timesteps,
                output=str(agent),
                resume=self.resume and holds_training(agent),
            ).run()
            Compare(
                config=str(agent / "config.yaml"),
                sweep="scale_free_sweep",
                policy=f"model:{agent / 'calibrated_model.zip'}",
                prices=7,
                episodes=self.episodes,
                output=folder / "comparison",
            ).run()
