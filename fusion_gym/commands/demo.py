"""Train two agents and compare them with rules under the same budget, in minutes.

    fusion-gym demo --output runs/demo --episodes 500

One agent learns in LinearFusion and one in the Tobit oscillator. Each agent observes all new
measurements and the price of a token, with memory of unsent measurements. A table shows the costs
at seven prices of the agent and of rules with the same memory, on the same episodes. Four lines at
the end say what the agents save, also against the oscillator's paper.

Two processes train and compare, one in each environment. The output of LinearFusion's is in
``demo.log`` in its folder until its end.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from fusion_gym.commands.command_line import OUTPUT_FOLDER, Episodes, Long, Steps
from fusion_gym.commands.compare import Compare
from fusion_gym.commands.train import Train
from fusion_gym.output import files
from fusion_gym.output.ending import ended_like_by_ctrl_c
from fusion_gym.output.progress import remark, writing
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
TRIGGERS = {"tobit_oscillator": "dynamic_event:scale={value}"}
AGENT = "model:calibrated_model.zip"
CONFIGS = {"linear_fusion": "linear_fusion_front", "tobit_oscillator": "tobit_oscillator_front"}
STEPS = {"tobit_oscillator": 600_000}  # after which the comparison hardly changes


@dataclass(frozen=True)
class Demo(Long):
    """Train two agents and compare them with rules under the same budget, in minutes."""

    output: Annotated[Path, OUTPUT_FOLDER] = Path("runs/demo")
    """Folder for agents, tables and figures."""
    episodes: Episodes = 500
    """Episodes of each policy."""
    timesteps: Steps = None
    """Steps of each training; by default 800,000 in LinearFusion, 600,000 in the oscillator."""
    resume: bool = False
    """Continue the trainings in the folder; resume only your own, since they contain pickles."""
    only: Literal["linear_fusion", "tobit_oscillator"] | None = None
    """Train and compare in one environment only."""

    def run(self) -> None:
        """Train and compare in one environment, and beside it in the other."""
        for name in [self.only] if self.only else CONFIGS:
            agent = self.output / name / "agent"
            if holds_training(agent) and not self.resume:
                raise files.folder_refusal(agent, "a training")
        with ended_like_by_ctrl_c():
            if self.only:
                self._train_and_compare(self.only)
                return
            beside, here = CONFIGS
            with self.process(beside):
                self._train_and_compare(here)
        lines = {
            "trained": f"{len(CONFIGS)} agents, calibrated: {', '.join(CONFIGS)}",
            "saved against the best rule at each price": ", ".join(map(self._saving, CONFIGS)),
            f"saved against the paper's trigger ({here})": self._saving(here, TRIGGERS[here]),
            "pictures": self.output / "*" / "comparison" / "pareto.png",
        }
        print("\n".join(f"{title:50} {text}" for title, text in lines.items()))

    def _train_and_compare(self, name: str) -> None:
        """Train the agent of an environment, and compare it with the rules."""
        folder = self.output / name
        agent, steps = folder / "agent", self.timesteps or STEPS.get(name)
        resume = holds_training(agent)
        Train(config=CONFIGS[name], timesteps=steps, output=str(agent), resume=resume).run()
        rules = RULES if name not in TRIGGERS else (*RULES, TRIGGERS[name])
        Compare(
            config=str(agent / "config.yaml"),
            policies=((f"model:{agent / 'calibrated_model.zip'}", *rules),),
            prices=7,
            episodes=self.episodes,
            output=folder / "comparison",
        ).run()

    @contextmanager
    def process(self, name: str) -> Iterator[None]:
        """Train and compare in another process; at its end, print what it has printed."""
        words = [*sys.argv[1:], f"--only={name}"]
        command = [sys.executable, "-m", "fusion_gym.commands", "demo", *words]
        tables, log = (self.output / name / file for file in ("tables.txt", "demo.log"))
        log.parent.mkdir(parents=True, exist_ok=True)
        writing((f"the output of {name}", log))
        size = {"FORCE_COLOR": "1", "COLUMNS": str(shutil.get_terminal_size().columns)}
        environ = os.environ | (size if sys.stdout.isatty() else {})
        with tables.open("w") as out, log.open("w") as err:
            process = subprocess.Popen(command, stdout=out, stderr=err, env=environ)
        try:
            yield
            if process.poll() is None:
                remark(f"waiting for {name}: see {log}")
            process.wait()
        except BaseException:
            process.terminate()  # it writes a checkpoint
            process.wait()
            raise
        if process.returncode:
            raise ConfigurationError(f"the process of {name} failed: see {log}")
        print(tables.read_text(), end="")

    def _saving(self, name: str, rule: str | None = None) -> str:
        """Return the mean saving against a rule, or the best rule, over the prices."""
        path = self.output / name / "comparison" / "comparison.json"
        rows = [row["policies"] for row in files.read_json(path, "output")["prices"]]
        agents = [row[AGENT] for row in rows]
        own = np.array([agent["mean"] for agent in agents])
        best = own - [agent["difference"]["mean"] for agent in agents]
        other = [row[rule]["mean"] for row in rows] if rule else best
        return f"{np.mean(1.0 - own / other):.1%}"
