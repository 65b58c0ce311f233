"""One training from config to summary, which can be interrupted and resumed.

From a checkpoint, one file, a training continues as if it had not been interrupted.

``docs/learning.md`` describes each diagnostic in a healthy training and the causes of deviations.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from fusion_gym import seeds
from fusion_gym.core.estimator import Estimator
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments, Plain
from fusion_gym.envs.registration import make_task
from fusion_gym.errors import forbidden
from fusion_gym.importing import trust_files
from fusion_gym.output import files
from fusion_gym.output.progress import progress_bar, quietly, remark, writing
from fusion_gym.validation import ConfigurationError, refusal

# Further imports stand in functions, because torch and Stable-Baselines3 take seconds to load.
if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from fusion_gym.envs.sb3 import FusionSB3VecEnv
    from fusion_gym.training.callbacks import Journal
    from fusion_gym.training.config import EnvironmentConfig, Experiment, TrainingConfig


def make_env(experiment: Experiment, task: Task) -> FusionSB3VecEnv:
    """Return the training environment."""
    from fusion_gym.envs.privileged import PrivilegedVecEnv
    from fusion_gym.envs.sb3 import FusionSB3VecEnv
    from fusion_gym.training.config import TABLE, BranchingConfig

    name, local = experiment.algorithm.name, experiment.environment.local
    several = task.options.access != "single" or task.options.action == "threshold"
    if not local and several and task.options.action not in TABLE[name].actions:
        reason = f"set the environment's option action: {' or '.join(TABLE[name].actions)}"
        raise forbidden("action", task.options.action, reason, f"with algorithm {name!r}")
    training, where = experiment.training, experiment.environment
    runs: Arguments = {
        "num_envs": training.num_envs,
        "stagger": True,
        "local": local,
        "price_exponent": training.price_exponent,
    }
    if isinstance(experiment.algorithm, BranchingConfig):
        return _rule_env(experiment.algorithm.rule, training, task, runs)
    reference = None
    if training.error != "squared":
        reference = _reference(task, where, training.error_filter)
    elif training.error_filter is not None:
        raise refusal("error_filter", training.error_filter, "none with error: squared")
    if reference is None and not TABLE[name].privileged:
        return FusionSB3VecEnv(task, **runs)
    return PrivilegedVecEnv(task, error=training.error, reference=reference, **runs)


def _rule_env(
    rule: str | None, training: TrainingConfig, task: Task, runs: Arguments
) -> FusionSB3VecEnv:
    """Return the environment of branches, with the rule at which they start."""
    from fusion_gym.evaluation.rule_search import class_of, search_of_class
    from fusion_gym.training.branching import RuleVecEnv
    from fusion_gym.training.callbacks import prices_of

    for name, allowed in (("error", "squared"), ("error_filter", None), ("price_exponent", 0.0)):
        if (value := getattr(training, name)) != allowed:
            raise refusal(name, value, repr(allowed), "with algorithm 'branching_ppo'")
    prices = prices_of(task)
    if rule is None:
        search = search_of_class(class_of(task, runs["local"]), task, prices, episodes=(16, 100))
        rule = search.policy(search.first_point())
    return RuleVecEnv(task, rule=rule, prices=prices, **runs)


def _reference(task: Task, where: EnvironmentConfig, error_filter: str | None) -> Estimator[Any]:
    """Return the estimator that processes every measurement, if possible the task's memory."""
    from fusion_gym.envs.privileged import reference_estimator

    own = error_filter in (None, where.options.get("memory_filter"))
    if own and task.memory_estimator is not None:
        return task.memory_estimator
    try:
        return reference_estimator(where.id, where.options, error_filter)
    except ConfigurationError as error:
        if error_filter is None:
            raise
        raise forbidden("error_filter", error_filter, str(error)) from None


def make_model(experiment: Experiment, env: FusionSB3VecEnv) -> BaseAlgorithm:
    """Return a new model of the config's algorithm."""
    from fusion_gym.policies.saved import tag_model
    from fusion_gym.training.config import TABLE

    settings = experiment.algorithm
    row = TABLE[settings.name]
    try:
        model = row.model(
            row.policy, env, seed=experiment.training.seed, device="cpu", **settings.arguments()
        )
    except (AssertionError, ValueError) as error:  # checks of Stable-Baselines3
        reason = " ".join(str(error).split())
        raise forbidden("algorithm", settings.name, reason, "with these settings") from None
    rate = getattr(settings, "initial_rate", None)
    if rate is not None:
        _begin_at(model, env, rate)
    tag_model(model, env.task, experiment.environment.local, getattr(env, "text", None))
    return model


def _begin_at(model: BaseAlgorithm, env: FusionSB3VecEnv, rate: float) -> None:
    """Shift the last layer's offsets so that the untrained policy requests at this rate."""
    import torch

    logits = env.view.action.logits(rate)
    head = model.policy.action_net
    assert isinstance(head, torch.nn.Linear)
    if logits.size == 2 * head.out_features:  # one output per sensor
        logits = logits[1::2]
    with torch.no_grad():
        head.bias.add_(torch.as_tensor(logits, dtype=head.bias.dtype))


class Summary(TypedDict):
    """The summary of a training: ``seconds`` by activity, and a hash of its inputs."""

    timesteps: int
    finished: bool
    steps_per_second: int
    seconds: dict[str, float]
    best_validation: Plain | None
    inputs: str


def holds_training(folder: Path) -> bool:
    """Return whether the folder contains a training."""
    return any((folder / name).exists() for name in ("config.yaml", "latest.zip"))


def earlier(experiment: Experiment, folder: Path, resume: bool) -> Journal | None:
    """Return the journal of the training to resume, or None for a new training."""
    from fusion_gym.training.callbacks import read_journal
    from fusion_gym.training.config import Experiment, load_checked

    where, checkpoint = f"the training in {str(folder)!r}", folder / "latest.zip"
    if not resume:
        if holds_training(folder):
            raise files.folder_refusal(folder, "a training")
        return None
    if checkpoint.exists():
        journal = read_journal(checkpoint)
        files.check_inputs(experiment.inputs(), journal.inputs, where)
        return journal
    if (folder / "final_model.zip").exists():
        raise ConfigurationError(
            f"output = {str(folder)!r} holds a finished training without its checkpoint, "
            "latest.zip: nothing to resume"
        )
    with trust_files():  # a checkpoint there would contain code, too
        begun = load_checked(Experiment, folder / "config.yaml")
    files.check_inputs(experiment.inputs(), begun.inputs(), where)
    return None


def check_run(experiment: Experiment) -> tuple[BaseAlgorithm, FusionSB3VecEnv, Task]:
    """Return a new model, its environment and the task of its validation, without writing."""
    task = make_task(experiment.environment.id, **experiment.environment.options)
    env = make_env(experiment, task)
    return make_model(experiment, env), env, task


def train(
    experiment: Experiment,
    *,
    resume: bool = False,
    quiet: bool = False,
    callbacks: Sequence[BaseCallback] = (),
) -> Summary:
    """Run the training and return its summary.

    The summary has ``timesteps``, ``finished``, ``steps_per_second``, ``seconds`` by activity (over
    all parts of the training), the best validation, and a hash of the inputs.

    Args:
        experiment: the config.
        resume: whether to continue the training in the output folder.
        quiet: whether to print neither progress nor summary.
        callbacks: callbacks of Stable-Baselines3, which run beside the training's own.

    Raises:
        ConfigurationError: a config, environment or folder that does not fit; a config that is not
            allowed leaves no folder.

    Example:
        >>> import tempfile
        >>> from fusion_gym import Experiment, train
        >>> config = {
        ...     "environment": {"id": "fusion_gym/LinearFusion-v2", "options": {"horizon": 10}},
        ...     "algorithm": {"name": "ppo", "n_steps": 8, "batch_size": 64},
        ...     "training": {"timesteps": 64, "num_envs": 8},
        ...     "validation": {"episodes": 2},
        ... }
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     experiment = Experiment.model_validate(config | {"output": f"{folder}/ppo"})
        ...     train(experiment, quiet=True)["finished"]
        True
    """
    import torch
    import yaml

    from fusion_gym.training.callbacks import Journal, restore

    folder = Path(experiment.output)
    if resume and not holds_training(folder):
        raise ConfigurationError(f"output = {str(folder)!r} holds no training: nothing to resume")
    model, env, scored = check_run(experiment)
    experiment = experiment.resolved(env.task.settings, env.task.sensors)
    earlier(experiment, folder, resume)  # refuses before it creates a folder
    torch.set_num_threads(experiment.training.threads)
    with files.lock_folder(folder, "output"):
        journal = earlier(experiment, folder, resume)
        if journal is None:
            journal = Journal(experiment.inputs())
            env.seed(seeds.TRAINING[seeds.STRIDE * experiment.training.seed])
        else:
            model = restore(folder / "latest.zip", type(model), env)
        if not quiet:
            writing(("checkpoints, models and validations", folder))
        plain = experiment.model_dump(mode="json")
        files.write_text(folder / "config.yaml", yaml.safe_dump(plain, sort_keys=False))
        return _learn(experiment, folder, model, scored, journal, quiet, callbacks)


def _learn(
    experiment: Experiment, folder: Path, model: BaseAlgorithm, scored: Task,
    journal: Journal, quiet: bool, others: Sequence[BaseCallback],
) -> Summary:  # fmt: skip
    """Train the remaining steps, write the results and return the summary."""
    from stable_baselines3.common.callbacks import CallbackList
    from stable_baselines3.common.logger import configure

    from fusion_gym.training import callbacks as own

    model.set_logger(configure(str(folder / "tensorboard"), ["tensorboard"]))
    total, begun, began = experiment.training.timesteps, model.num_timesteps, time.perf_counter()
    with (
        own.Interrupt() as interrupt,
        progress_bar(total, f"training {experiment.algorithm.name}", begun, quiet) as bar,
    ):
        progress = own.Progress(experiment, folder, scored, interrupt, bar, journal)
        progress.init_callback(model)
        callbacks: list[BaseCallback] = [own.Traffic(), progress, *others]
        if begun < total:
            try:
                model.learn(total - begun, CallbackList(callbacks), reset_num_timesteps=False)
            except own.Stop:
                pass
            except ValueError:  # torch's distributions refuse infinite weights
                if all(bool(part.isfinite().all()) for part in model.policy.parameters()):
                    raise
                raise ConfigurationError(
                    f"output = {str(folder)!r}: the training diverged after {model.num_timesteps} "
                    "steps, its weights are not finite; lower learning_rate or max_grad_norm"
                ) from None
        progress.num_timesteps = model.num_timesteps
        finished = model.num_timesteps >= total
        if finished:
            progress.finish()
            if not quiet:
                own.warn_of_unused_tokens(scored, progress.last[0].tokens)
                own.warn_of_silence(progress.last)
        progress.save()
        if finished:
            with files.replacing(folder / "final_model.zip") as partial:
                model.save(partial)
            if experiment.calibration and len(progress.prices) > 1 and journal.best:
                bar.say("calibrating")
                with quietly(quiet):
                    _calibrate(folder, scored, progress.prices, experiment.calibration.episodes)
    best = min(journal.records, key=lambda record: record["relative_cost"], default=None)
    summary: Summary = {
        "timesteps": model.num_timesteps,
        "finished": finished,
        "steps_per_second": round(model.num_timesteps / (sum(journal.seconds.values()) or 1.0)),
        "seconds": {key: round(value, 2) for key, value in journal.seconds.items()},
        "best_validation": best and {key: value for key, value in best.items() if key != "prices"},
        "inputs": files.fingerprint(journal.inputs),
    }
    files.write(folder / "summary.json", summary)
    if not quiet:
        print(describe(summary, folder, time.perf_counter() - began))
    return summary


def _calibrate(
    folder: Path, task: Task, prices: Sequence[float], episodes: tuple[int, int]
) -> None:
    """Write the calibrated policy of the best model, if that has one logit for each sensor."""
    from fusion_gym.policies.saved import load_model_policy
    from fusion_gym.training.calibration import calibrate

    file = folder / "best_model.zip"
    agent = load_model_policy(str(file), task)
    try:
        agent.check_logits()
    except ConfigurationError as error:
        remark(f"no calibrated model: {error}")
        return
    calibrate(task, [file], prices, episodes, folder / "calibrated_model.zip")


def describe(summary: Summary, folder: Path, elapsed: float) -> str:
    """Return the summary of a training as text in a few lines."""
    lines = [
        f"{'finished' if summary['finished'] else 'interrupted'} after {summary['timesteps']:,} "
        f"steps at {summary['steps_per_second']:,} steps/s; this session: {elapsed:.0f} s"
    ]
    total = sum(summary["seconds"].values())
    if total > 0.0:
        parts = (f"{key} {value / total:.0%}" for key, value in summary["seconds"].items())
        lines.append("wall time: " + ", ".join(parts))
    best = summary["best_validation"]
    if best:
        lines.append(
            f"best validation at {best['timesteps']:,} steps: return {best['return']:.3f}, "
            f"MSE {best['mse']:.4f}, rate {best['rate']:.4f}"
        )
    return "\n".join([*lines, f"results in {folder}"])
