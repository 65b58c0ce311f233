"""Train a Stable-Baselines3 agent on the native vector environment.

    fusion-gym train --config tobit_oscillator_ppo
    fusion-gym train --env fusion_gym/LinearFusion-v2 --timesteps 200000

The config's ``output`` folder receives ``config.yaml``, ``latest.zip`` (the checkpoint),
``best_model.zip`` (the least validation cost relative to single thresholds),
``validation.jsonl`` and ``tensorboard/``, and at the end ``final_model.zip`` and ``summary.json``.
A training at drawn prices also writes ``calibrated_model.zip``, if the agent has one logit for each
sensor.

The command writes a checkpoint after every validation. Ctrl-C and SIGTERM end the training after
the current rollout with a checkpoint; a second Ctrl-C ends it at once, without one. ``--resume``
continues from the last checkpoint. On one machine, with the same packages and threads, the models
are then bitwise equal to the models of an uninterrupted training. The config must be the same;
``timesteps`` may grow (schedules then stretch over all of them), and ``output`` and ``threads`` may
change.

A checkpoint contains pickles, and the loader of Stable-Baselines3 runs their code. Resume only your
own trainings.
"""

import re
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from fusion_gym.commands.command_line import (
    OUTPUT_FOLDER,
    Long,
    SetOptions,
    Steps,
    TrainingSeed,
    writable_folder,
)
from fusion_gym.errors import forbidden
from fusion_gym.policies.registry import parse_settings
from fusion_gym.training.run import holds_training, train
from fusion_gym.validation import ConfigurationError

if TYPE_CHECKING:
    from fusion_gym.training.config import Experiment

TIMESTEPS = 1_000_000  # of a training without a config


@dataclass(frozen=True)
class Train(Long):
    """Train a Stable-Baselines3 agent on the native vector environment."""

    config: str | None = None
    """The experiment: a YAML file, or the name of a shipped config."""
    env: str | None = None
    """Id of a registered environment, instead of a config."""
    algorithm: str | None = None
    """Algorithm for --env, with its default settings: ppo by default."""
    options: SetOptions = ()
    """Options of gym.make for the environment; they override the options of the config."""
    timesteps: Steps = None
    """Steps of all runs together; by default the config's steps, or a million with --env."""
    seed: TrainingSeed = None
    """Seed of the training, instead of the config's seed."""
    output: Annotated[str | None, OUTPUT_FOLDER] = None
    """Folder for the results, instead of the config's folder."""
    resume: bool = False
    """Continue from the last checkpoint; resume only your own, since it contains pickles."""

    def experiment(self) -> "Experiment":
        """Return the config with the options of the command line, checked again."""
        return self._base_experiment().changed(
            self.output,
            parse_settings("option", list(chain(*self.options))),
            timesteps=self.timesteps,
            seed=self.seed,
        )

    def _base_experiment(self) -> "Experiment":
        """Return the config, or the default config of ``env`` and ``algorithm``."""
        # Imported here, because pydantic takes a tenth of a second to load.
        from fusion_gym.training.config import Experiment, checked, load_checked

        if (self.config is None) == (self.env is None):
            raise forbidden("config", self.config, "give one of them", f"with env = {self.env!r}")
        if self.config is not None:
            if self.algorithm is not None:
                where = f"with config = {self.config!r}"
                reason = "the config names the algorithm"
                raise forbidden("algorithm", self.algorithm, reason, where)
            return load_checked(Experiment, self.config)
        algorithm = self.algorithm or "ppo"
        name = re.sub(r"\W+", "_", f"{str(self.env).rpartition('/')[2]}_{algorithm}").lower()
        content = {
            "environment": {"id": self.env},
            "algorithm": {"name": algorithm},
            "training": {"timesteps": TIMESTEPS},
            "output": f"runs/{name}",
        }
        return checked(Experiment, content, "config 'command line'")

    def run(self) -> None:
        """Train up to the number of steps in the config."""
        experiment = self.experiment()
        writable_folder("output", Path(experiment.output))
        if not train(experiment, resume=self.resume)["finished"]:
            raise KeyboardInterrupt

    def interrupted(self) -> str:
        """Return how to resume, if the training has begun."""
        try:
            begun = holds_training(Path(self.experiment().output))
        except ConfigurationError:
            begun = False
        return super().interrupted() if begun else "interrupted before the training began"
