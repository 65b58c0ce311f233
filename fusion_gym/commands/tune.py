"""Find an agent's hyper-parameters with Optuna, in a study that can be gone on with.

    fusion-gym tune --config configs/tobit_oscillator_ppo.yaml --trials 30 \\
        --timesteps 1000000 --output runs/tune/tobit_oscillator

The study is a SQLite file in the output folder: running the command again goes on with it until it
has the trials asked for, as if it had not been interrupted. The first trial is the config itself,
where its values lie in the search. Trials that fall behind at a validation
are pruned, and so are those that diverge. ``best.yaml`` is the config with what was found, and the
command that found it.

With ``--storage`` the study is in a database that several processes share, on this machine or
others, each with an output folder of its own: the same command for all of them does the trials
together. What a trial tries then depends on who is first, and the trial of a process that is gone
is made anew.
"""

import contextlib
import sqlite3
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import optuna
import yaml
from optuna.exceptions import ExperimentalWarning, StorageInternalError
from optuna.trial import TrialState
from sqlalchemy.exc import IntegrityError, OperationalError, SQLAlchemyError

from fusion_gym.commands.command_line import Long
from fusion_gym.commands.options import OutputFolder, Steps, Whole
from fusion_gym.output.files import write_text
from fusion_gym.output.folders import alone_in, check_inputs, fingerprint
from fusion_gym.output.progress import Bar, progress_bar, writing
from fusion_gym.training.checked import load_checked, parse
from fusion_gym.training.config import Experiment
from fusion_gym.training.run import Diverged, check_run, holds_training, train
from fusion_gym.validation import ConfigurationError, refusal

optuna.logging.set_verbosity(optuna.logging.WARNING)

# What is searched, for the algorithms that have it.
NUMBERS = {"learning_rate": (3e-4, 5e-3), "ent_coef": (1e-5, 3e-2)}
CHOICES: dict[str, tuple[Any, ...]] = {
    "gamma": (0.9, 0.95, 0.97, 0.99, 0.995),
    "gae_lambda": (0.8, 0.9, 0.95, 1.0),
    "n_epochs": (2, 4, 8),
    "hidden": ("64,64", "128,128"),
}
_ENDED = (TrialState.COMPLETE, TrialState.PRUNED)
_HEARTBEAT = 60  # seconds between two signs of life of who makes a trial in a shared study
_OPENINGS, _PAUSE = 4, 0.3  # tries to open a storage, and seconds between them
FACTORS = (0.25, 0.5, 1, 2)  # of the config's steps between two updates


@dataclass(frozen=True)
class Tune(Long):
    """Find an agent's hyper-parameters with Optuna, in a study that can be gone on with."""

    config: str
    """The experiment to begin with: a YAML file, or the name of a shipped config."""
    output: Annotated[Path, OutputFolder()]
    """Folder of the study."""
    trials: Annotated[int, Whole(1, 1_000_000)] = 30
    """Trials of the study in all."""
    timesteps: Steps = None
    """Steps of a trial, instead of the config's."""
    storage: str | None = None
    """A database that processes share, as Optuna names it: postgresql://… or sqlite:///FILE."""

    def run(self) -> None:
        """Search, and write the best config under the command that found it."""
        experiment = load_checked(Experiment, self.config)
        plain = experiment.model_dump()
        if self.timesteps is not None:
            plain["training"]["timesteps"] = self.timesteps
            plain["validation"]["every"] = max(self.timesteps // 5, 1)
        study = tune(
            parse(Experiment, plain, "command line"), self.trials, self.output, self.storage
        )
        if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            raise ConfigurationError(
                f"trials = {self.trials} is not enough: all of them were pruned"
            )
        path = self.output / "best.yaml"
        write_text(path, best_config(study, experiment, self.again()))
        print(f"best return {study.best_value:.4g} with {study.best_params}; config in {path}")


def _choices(experiment: Experiment) -> dict[str, tuple[Any, ...]]:
    """The values among which a study of this experiment chooses, by name."""
    own = getattr(experiment.algorithm, "n_steps", 1)
    steps = tuple(sorted({max(round(own * factor), 1) for factor in FACTORS}))
    return CHOICES | {"n_steps": steps}


def suggest(trial: optuna.Trial, experiment: Experiment, output: Path) -> Experiment:
    """The experiment with a trial's hyper-parameters."""
    plain = experiment.model_dump()
    algorithm = plain["algorithm"]
    for name, (low, high) in NUMBERS.items():
        if name in algorithm:
            algorithm[name] = trial.suggest_float(name, low, high, log=True)
    for name, values in _choices(experiment).items():
        if name in algorithm or name == "hidden":
            value = trial.suggest_categorical(name, list(values))
            if name == "hidden":
                algorithm["network"]["hidden"] = [int(part) for part in value.split(",")]
            else:
                algorithm[name] = value
    plain["output"] = str(output)
    return Experiment.model_validate(plain)


def tune(
    experiment: Experiment, trials: int, folder: Path, storage: str | None = None
) -> optuna.Study:
    """Trials until the study in the folder has so many that ended.

    A trial's value is its best validation return. With a target rate, which that does not
    measure, tuning is refused. A study that is gone on with makes the trials that it would have
    made uninterrupted: each draws from a generator of its own, and an unfinished one is gone on
    with. In a ``storage`` other processes make trials of the same study.

    Raises:
        ConfigurationError: a target rate, an environment or algorithm that is not allowed, or a
            study of another config.
    """
    if experiment.training.target_rate is not None:
        raise ConfigurationError(
            f"target_rate = {experiment.training.target_rate} is not allowed in tuning: trials "
            "are compared by their return at a fixed price"
        )
    check_run(experiment)
    try:
        shared = None if storage is None else shared_study(experiment, storage)
        if shared is None and ((folder / "study.db").exists() or any(folder.glob("trial_*"))):
            open_study(experiment, folder)  # refuses before anything is made
        with alone_in(folder, "output"):
            writing(("study, trials and best.yaml", folder))
            study = shared or open_study(experiment, folder)
            search(study, experiment, trials, folder, shared is not None)
            return study
    except (sqlite3.Error, StorageInternalError) as error:
        reason = str(error.__cause__ or error).splitlines()[0]
        where = f"storage = {storage!r}" if storage else f"study = {str(folder / 'study.db')!r}"
        raise ConfigurationError(f"{where} cannot be read or written: {reason}") from None


def open_study(experiment: Experiment, folder: Path) -> optuna.Study:
    """The study in the folder, a new one if there is none.

    Raises:
        ConfigurationError: it is of another config, or it is gone and its trials are there.
        sqlite3.Error: it is damaged.
    """
    path = folder / "study.db"
    inputs = inputs_of(experiment)
    if path.exists() and path.stat().st_size > 0:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            answer = connection.execute("PRAGMA quick_check").fetchone()[0]
        if answer != "ok":
            raise sqlite3.DatabaseError(answer)
    elif any(folder.glob("trial_*")):
        raise ConfigurationError(
            f"output = {str(folder)!r} holds trials without their study, study.db: give another "
            "--output"
        )
    study = _study("tune", f"sqlite:///{path}")
    if study.get_trials(deepcopy=False) or "inputs" in study.user_attrs:
        check_inputs(inputs, study.user_attrs.get("inputs"), f"the study in {str(folder)!r}")
    study.set_user_attr("inputs", inputs)
    study.set_user_attr("made_from", fingerprint(inputs))
    return study


def inputs_of(experiment: Experiment) -> dict[str, Any]:
    """All that a study depends on."""
    return {"timesteps": experiment.training.timesteps} | experiment.inputs()


def _study(
    name: str,
    storage: str | optuna.storages.RDBStorage,
    sampler: optuna.samplers.BaseSampler | None = None,
) -> optuna.Study:
    """The study of this name in a storage, a new one if there is none."""
    pruner = optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=1)
    return optuna.create_study(
        study_name=name,
        storage=storage,
        sampler=sampler,
        pruner=pruner,
        load_if_exists=True,
        direction="maximize",
    )


def search(
    study: optuna.Study, experiment: Experiment, trials: int, folder: Path, shared: bool
) -> None:
    """Make trials until so many have ended, or are being made by others who share the study."""
    if not shared:
        for trial in study.get_trials(states=(TrialState.RUNNING,)):
            study.tell(trial.number, state=TrialState.FAIL)  # its process is gone
    active = (*_ENDED, TrialState.RUNNING)
    with progress_bar(trials, "tuning", min(ended(study), trials), unit="trials") as bar:
        while len(study.get_trials(deepcopy=False, states=active)) < trials:
            if not ended(study) and not study.get_trials(states=(TrialState.WAITING,)):
                begin_with(study, experiment)
            place = ended(study)
            if not shared:
                study.sampler = sampler(experiment, place)

            def run(trial: optuna.Trial, place: int = place) -> float:
                output = folder / f"trial_{trial.number if shared else place}"
                return run_trial(trial, experiment, output, bar)

            study.optimize(run, 1)
            bar.reach(ended(study))


def shared_study(experiment: Experiment, storage: str) -> optuna.Study:
    """The study of this experiment in a storage, a new one if there is none: each has its name.

    Raises:
        ConfigurationError: a storage that cannot be opened.
    """
    inputs = inputs_of(experiment)
    try:
        result = _opened(storage)
    except (SQLAlchemyError, ImportError) as error:
        reason = str(error).splitlines()[0]
        raise refusal("storage", storage, f"a database's URL ({reason})") from None
    liar = optuna.samplers.TPESampler(constant_liar=True)
    study = _study(f"tune_{fingerprint(inputs)[:16]}", result, liar)
    study.set_user_attr("inputs", inputs)
    return study


def _opened(storage: str) -> optuna.storages.RDBStorage:
    """The storage; another process that makes its tables at the same moment is waited for.

    Raises:
        SQLAlchemyError: it cannot be opened, or read.
        ImportError: the database's driver is absent.
    """
    for left in range(_OPENINGS - 1, -1, -1):
        try:
            with warnings.catch_warnings():  # signs of life are an experiment of Optuna's
                warnings.simplefilter("ignore", ExperimentalWarning)
                return optuna.storages.RDBStorage(
                    storage, heartbeat_interval=_HEARTBEAT, grace_period=3 * _HEARTBEAT
                )
        except (IntegrityError, OperationalError):
            if not left:
                raise
            time.sleep(_PAUSE)
    raise AssertionError


def begin_with(study: optuna.Study, experiment: Experiment) -> None:
    """Let the config's own hyper-parameters be the first trial, where the search has them."""
    algorithm = experiment.algorithm.model_dump()
    own: dict[str, Any] = {name: algorithm[name] for name in NUMBERS if name in algorithm}
    values = _choices(experiment)
    own |= {name: algorithm[name] for name in values if name in algorithm}
    own["hidden"] = ",".join(str(size) for size in experiment.algorithm.network.hidden)
    inside = all(low <= own[name] <= high for name, (low, high) in NUMBERS.items() if name in own)
    if inside and all(own[name] in some for name, some in values.items() if name in own):
        study.enqueue_trial(own, skip_if_exists=True)


def ended(study: optuna.Study) -> int:
    """Number of trials that came to an end of their own, not by an interrupt."""
    return len(study.get_trials(deepcopy=False, states=_ENDED))


def sampler(experiment: Experiment, place: int) -> optuna.samplers.BaseSampler:
    """What chooses the study's trial of this place: its numbers depend on nothing but that."""
    seeds = np.random.SeedSequence([experiment.training.seed, place])
    return optuna.samplers.TPESampler(seed=int(seeds.generate_state(1)[0]))


def run_trial(trial: optuna.Trial, experiment: Experiment, output: Path, bar: Bar) -> float:
    """Train with a trial's hyper-parameters in a folder; returns the best validation return.

    The ``bar`` of all trials shows how far it is.

    Raises:
        TrialPruned: it fell behind, or diverged.
        KeyboardInterrupt: it was interrupted.
    """
    trial.set_user_attr("folder", output.name)
    suggestion = suggest(trial, experiment, output)
    best, begun = -float("inf"), bar.done
    pruned = False

    def watch(record: dict[str, Any]) -> bool:
        nonlocal best, pruned
        best = max(best, record["return"])
        part = record["timesteps"] / suggestion.training.timesteps
        bar.say(f"{output.name}: {part:.0%}, return {best:.4g}")
        bar.reach(begun, (begun + min(part, 1.0)) / bar.total)
        if record["timesteps"] >= suggestion.training.timesteps:
            return False  # the finished model's validation
        trial.report(best, record["timesteps"])
        pruned = trial.should_prune()
        return pruned

    try:
        summary = train(suggestion, resume=holds_training(output), quiet=True, watch=watch)
    except Diverged:
        pruned = True
    if pruned:
        raise optuna.TrialPruned
    if not summary["finished"]:
        raise KeyboardInterrupt
    return best


def best_config(study: optuna.Study, experiment: Experiment, command: str) -> str:
    """The config with the best trial's hyper-parameters, as YAML under the command."""
    result = optuna.trial.FixedTrial(study.best_params)
    suggestion = suggest(result, experiment, Path(experiment.output))  # type: ignore[arg-type]
    plain = suggestion.model_dump(mode="json", exclude_none=True)
    value = f"best of {ended(study)} trials, validation return {study.best_value:.4g}"
    return f"# Found by {command}: {value}.\n" + yaml.safe_dump(plain, sort_keys=False)
