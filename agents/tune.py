"""Find an agent's hyper-parameters with Optuna, in a study that can be gone on with.

    python -m agents.tune --config configs/tobit_oscillator_ppo.yaml --trials 30 \\
        --timesteps 1000000 --output runs/tune/tobit_oscillator

The study is a SQLite file in the output folder: running the command again goes on with it until it
has the trials asked for. Trials that fall behind at a validation are pruned. ``best.yaml`` is the
config with what was found, and the command that found it.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.trial import TrialState

from fusion_gym.validation import ConfigurationError, integer

from .command_line import Command, spelled, start
from .output.files import write_text
from .training.checked import load, parse
from .training.config import Experiment
from .training.run import train

optuna.logging.set_verbosity(optuna.logging.WARNING)

# What is searched, for the algorithms that have it.
NUMBERS = {"learning_rate": (3e-4, 5e-3), "ent_coef": (1e-5, 3e-2)}
CHOICES: dict[str, tuple[Any, ...]] = {
    "gamma": (0.9, 0.95, 0.97, 0.99, 0.995),
    "gae_lambda": (0.8, 0.9, 0.95, 1.0),
    "n_steps": (16, 32, 64, 128),
    "n_epochs": (2, 4, 8),
    "hidden": ("64,64", "128,128"),
}


@dataclass(frozen=True)
class Tune(Command):
    """Find an agent's hyper-parameters with Optuna, in a study that can be gone on with."""

    config: str
    """The experiment to begin with: a YAML file, or the name of a shipped config."""
    output: Path
    """Folder of the study."""
    trials: int = 30
    """Trials of the study in all."""
    timesteps: int | None = None
    """Steps of a trial, instead of the config's."""

    def run(self) -> None:
        """Search, and write the best config under the command that found it."""
        integer("trials", self.trials, at_least=1)
        experiment = load(Experiment, self.config)
        plain = experiment.model_dump()
        if self.timesteps is not None:
            plain["training"]["timesteps"] = self.timesteps
            plain["validation"]["every"] = max(self.timesteps // 5, 1)
        try:
            study = tune(parse(Experiment, plain, "command line"), self.trials, self.output)
            command = shlex.join([*spelled("tune").split(), *sys.argv[1:]])
            path = self.output / "best.yaml"
            write_text(path, best_config(study, experiment, command))
        except ValueError as error:
            raise ConfigurationError(str(error)) from None
        print(f"best return {study.best_value:.4g} with {study.best_params}; config in {path}")

    def interrupted(self) -> str:
        """Finished trials are kept."""
        return "interrupted; the same command goes on"


def suggest(trial: optuna.Trial, experiment: Experiment, folder: Path) -> Experiment:
    """The experiment with a trial's hyper-parameters."""
    plain = experiment.model_dump()
    algorithm = plain["algorithm"]
    for name, (low, high) in NUMBERS.items():
        if name in algorithm:
            algorithm[name] = trial.suggest_float(name, low, high, log=True)
    for name, values in CHOICES.items():
        if name in algorithm or name == "hidden":
            value = trial.suggest_categorical(name, list(values))
            if name == "hidden":
                algorithm["network"]["hidden"] = [int(part) for part in value.split(",")]
            else:
                algorithm[name] = value
    plain["output"] = str(folder / f"trial_{trial.number}")
    return Experiment.model_validate(plain)


def tune(experiment: Experiment, trials: int, folder: Path) -> optuna.Study:
    """Trials until the study in the folder has so many that ended.

    A trial's value is its best validation return. With a target rate, which that does not
    measure, tuning is refused.

    Raises:
        ConfigurationError: a target rate, or an environment that is not allowed.
    """
    if experiment.training.target_rate is not None:
        raise ConfigurationError(
            f"target_rate = {experiment.training.target_rate} is not allowed in tuning: trials "
            "are compared by their return at a fixed price"
        )
    folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name="tune",
        storage=f"sqlite:///{folder / 'study.db'}",
        load_if_exists=True,
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=experiment.training.seed),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=1),
    )

    def objective(trial: optuna.Trial) -> float:
        chosen = suggest(trial, experiment, folder)
        best = -float("inf")
        pruned = False

        def watch(record: dict[str, Any]) -> bool:
            nonlocal best, pruned
            best = max(best, record["return"])
            if record["timesteps"] >= chosen.training.timesteps:
                return False  # the training ends with one more validation at the same step
            trial.report(best, record["timesteps"])
            pruned = trial.should_prune()
            return pruned

        summary = train(chosen, quiet=True, watch=watch)
        if pruned:
            raise optuna.TrialPruned
        if not summary["finished"]:
            raise KeyboardInterrupt
        return best

    ended = len(study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED)))
    study.optimize(objective, n_trials=max(trials - ended, 0), show_progress_bar=True)
    return study


def best_config(study: optuna.Study, experiment: Experiment, command: str) -> str:
    """The config with the best trial's hyper-parameters, as YAML under the command."""
    chosen = suggest(optuna.trial.FixedTrial(study.best_params), experiment, Path())  # type: ignore[arg-type]
    plain = chosen.model_dump(mode="json", exclude_none=True) | {"output": experiment.output}
    value = f"best of {len(study.trials)} trials, validation return {study.best_value:.4g}"
    return f"# Found by {command}: {value}.\n" + yaml.safe_dump(plain, sort_keys=False)


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Tune)


if __name__ == "__main__":
    main()
