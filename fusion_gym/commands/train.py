"""Train a Stable-Baselines3 agent on the native vector environment.

    fusion-gym train --config tobit_oscillator_ppo [--resume]
    fusion-gym train --env fusion_gym/LinearFusion-v2 --algorithm ppo --timesteps 200000

Into the config's ``output`` folder go, as they are made: ``config.yaml``, ``latest.zip`` (the
checkpoint), ``best_model.zip`` (best return on the validation seeds), ``validation.jsonl``,
``tensorboard/`` and at the end ``final_model.zip`` and ``summary.json``.

Ctrl-C and SIGTERM end the training after the current rollout with a checkpoint (a second Ctrl-C
at once, without one), and there is one after every validation. ``--resume`` goes on from the last
as if nothing had happened: on one machine, with the same packages and threads, the models are
bitwise those of an uninterrupted training. The config must be the same; ``timesteps`` may be more
(schedules then stretch over all of them), ``output`` may have moved, ``threads`` may change.

A checkpoint holds pickles and is loaded by Stable-Baselines3's own loader: resume trainings of your
own alone, for a foreign folder runs whatever code is in it.
"""

import re
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated

from fusion_gym.commands.command_line import Long, SetOptions
from fusion_gym.commands.options import OutputFolder, Steps, TrainingSeed, writable_folder
from fusion_gym.policies.settings import parse_settings
from fusion_gym.training.checked import load_checked, parse
from fusion_gym.training.config import Experiment
from fusion_gym.training.run import holds_training, train
from fusion_gym.validation import ConfigurationError

TIMESTEPS = 1_000_000  # of a training without a config


@dataclass(frozen=True)
class Train(Long):
    """Train a Stable-Baselines3 agent on the native vector environment."""

    config: str | None = None
    """The experiment: a YAML file, or the name of a shipped config."""
    env: str | None = None
    """Id of a registered environment, in the place of a config."""
    algorithm: str | None = None
    """Algorithm for --env, with its defaults: ppo if none is given."""
    options: SetOptions = ()
    """Options of gym.make for the environment; they go before the config's."""
    timesteps: Steps = None
    """Steps of all runs together, instead of the config's, or of a million with --env."""
    seed: TrainingSeed = None
    """Seed of the training, instead of the config's."""
    output: Annotated[str | None, OutputFolder()] = None
    """Folder for the results, instead of the config's."""
    resume: bool = False
    """Go on from the last checkpoint, one of your own: it holds pickles."""

    def experiment(self) -> Experiment:
        """The config with what the command line says instead, checked again.

        Raises:
            ConfigurationError: a config or a value that is not allowed.
        """
        return self._base_experiment().changed(
            self.output,
            parse_settings("option", list(chain(*self.options))),
            timesteps=self.timesteps,
            seed=self.seed,
        )

    def _base_experiment(self) -> Experiment:
        """Return the config, or one of ``env`` and ``algorithm`` with defaults."""
        if (self.config is None) == (self.env is None):
            raise ConfigurationError(
                f"config = {self.config!r} is not allowed with env = {self.env!r}: give one of them"
            )
        if self.config is not None:
            if self.algorithm is not None:
                raise ConfigurationError(
                    f"algorithm = {self.algorithm!r} is not allowed with config = "
                    f"{self.config!r}: the config names the algorithm"
                )
            return load_checked(Experiment, self.config)
        algorithm = self.algorithm or "ppo"
        name = re.sub(r"\W+", "_", f"{str(self.env).rpartition('/')[2]}_{algorithm}").lower()
        content = {
            "environment": {"id": self.env},
            "algorithm": {"name": algorithm},
            "training": {"timesteps": TIMESTEPS},
            "output": f"runs/{name}",
        }
        return parse(Experiment, content, "command line")

    def run(self) -> None:
        """Train as far as the config says."""
        experiment = self.experiment()
        writable_folder("output", Path(experiment.output))
        if not train(experiment, resume=self.resume)["finished"]:
            raise KeyboardInterrupt

    def interrupted(self) -> str:
        """Nothing but a training that has begun is gone on with."""
        try:
            begun = holds_training(Path(self.experiment().output))
        except ConfigurationError:
            begun = False
        return super().interrupted() if begun else "interrupted before the training began"
