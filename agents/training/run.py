"""One training from config to summary; it can be interrupted at any step and gone on with."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure

from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.validation import ConfigurationError

from ..output.files import write
from ..output.progress import progress_bar
from .algorithms import TABLE
from .checked import load
from .config import Experiment
from .constraint import TargetRate, score
from .models import make_model
from .monitor import Interrupt, Progress, save

# Training seeds lie far from the validation's and from the small numbers that tests use.
TRAINING_SEEDS = 1_000_000_000


def prepare(experiment: Experiment, folder: Path, resume: bool) -> None:
    """Make the folder, or check that it holds the same experiment.

    Raises:
        ConfigurationError: the folder holds a training and ``resume`` is false, there is nothing
            to resume, or the training there had another config.
    """
    plain = experiment.model_dump(mode="json")
    file = folder / "config.yaml"
    if not resume:
        if file.exists():
            raise ConfigurationError(
                f"output = {str(folder)!r} holds a training already: go on with --resume, or give "
                "another --output"
            )
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(yaml.safe_dump(plain, sort_keys=False))
        return
    if not file.exists():
        raise ConfigurationError(f"output = {str(folder)!r} holds no training: nothing to resume")
    earlier = load(Experiment, file).model_dump(mode="json")
    for key in ("environment", "algorithm", "validation"):
        if earlier[key] != plain[key]:
            raise ConfigurationError(
                f"{key} = {plain[key]} differs from the training in {str(folder)!r}: {earlier[key]}"
            )
    file.write_text(yaml.safe_dump(plain, sort_keys=False))


def validation_task(experiment: Experiment, task: Task) -> Task:
    """The task that validation runs on: with a target rate its tokens are free of charge.

    Raises:
        ConfigurationError: a target rate, but a price that is drawn or zero.
    """
    if experiment.training.target_rate is None:
        return task
    price = task.reward.price
    if price.span is not None or not price.fixed:
        raise ConfigurationError(
            f"target_rate = {experiment.training.target_rate} is not allowed with cost_weight = "
            f"{experiment.environment.options.get('cost_weight')!r} and price_range = "
            f"{price.span}: it starts from a fixed cost_weight > 0 without a price_range"
        )
    return dataclasses.replace(
        task, reward=dataclasses.replace(task.reward, price=Price.create(0.0))
    )


def train(
    experiment: Experiment,
    *,
    resume: bool = False,
    quiet: bool = False,
    watch: Callable[[dict[str, Any]], bool] | None = None,
) -> dict[str, Any]:
    """Run the training and return its summary; ``quiet`` shows neither bar nor summary.

    ``watch`` is handed each validation's record and may end the training by returning true.

    The summary has ``timesteps``, ``finished``, ``steps_per_second``, ``seconds`` by activity,
    and the best validation.

    Raises:
        ConfigurationError: a config, environment or folder that does not fit.
    """
    task = make_task(experiment.environment.id, **experiment.environment.options)
    name = experiment.algorithm.name
    local = experiment.environment.local
    row = TABLE[name]
    many = not local and task.action != "discrete" and task.access != "single"
    if row.discrete_only and many:
        raise ConfigurationError(
            f"action = {task.action!r} is not allowed with algorithm {name!r}: set the "
            "environment's option action: discrete"
        )
    folder = Path(experiment.output)
    prepare(experiment, folder, resume)
    torch.set_num_threads(experiment.training.threads)
    env = FusionSB3VecEnv(
        task,
        experiment.training.num_envs,
        stagger=True,
        local=local,
        price_exponent=experiment.training.price_exponent,
    )
    checkpoint = folder / "latest.zip"
    if resume and checkpoint.exists():
        model = row.model.load(checkpoint, env=env, device="cpu")
        if (folder / "latest_buffer.pkl").exists():
            model.load_replay_buffer(folder / "latest_buffer.pkl")  # type: ignore[attr-defined]
    else:
        model = make_model(experiment, env)
    begun = model.num_timesteps
    remaining = experiment.training.timesteps - begun
    # Every stretch of a training gets noise of its own, also after an interrupt.
    env.seed(TRAINING_SEEDS + 10_000_019 * experiment.training.seed + begun)
    model.set_logger(configure(str(folder / "tensorboard"), ["tensorboard"]))
    began = time.perf_counter()
    with (
        Interrupt() as interrupt,
        progress_bar(experiment.training.timesteps, f"training {name}", begun, quiet) as bar,
    ):
        scored = validation_task(experiment, task)
        progress = Progress(experiment, folder, scored, interrupt, bar, watch)
        callbacks: list[BaseCallback] = [progress]
        if experiment.training.target_rate is not None:
            price = task.reward.price.fixed
            assert price is not None  # validation_task refuses a drawn price
            callbacks.append(TargetRate(experiment.training.target_rate, price))
        if remaining > 0:
            model.learn(remaining, callback=CallbackList(callbacks), reset_num_timesteps=False)
            progress.num_timesteps = model.num_timesteps
            bar.update(model.num_timesteps - bar.n)
            if not (interrupt.raised or progress.stopped):
                progress.validate()
            progress.save()
    elapsed = time.perf_counter() - began
    finished = model.num_timesteps >= experiment.training.timesteps
    if finished:
        save(model, folder / "final_model.zip")
    best = max(progress.records, key=lambda r: score(r, progress.target), default=None)
    summary = {
        "timesteps": model.num_timesteps,
        "finished": finished,
        "steps_per_second": round((model.num_timesteps - begun) / elapsed) if remaining > 0 else 0,
        "seconds": {key: round(value, 2) for key, value in progress.seconds.items()},
        "best_validation": best,
    }
    write(folder / "summary.json", summary)
    if not quiet:
        print(describe(summary, folder, elapsed))
    return summary


def describe(summary: dict[str, Any], folder: Path, elapsed: float) -> str:
    """What a reader wants to know of a training, in a few lines."""
    lines = [
        f"{'finished' if summary['finished'] else 'interrupted'} after {summary['timesteps']:,} "
        f"steps; this stretch: {elapsed:.0f} s, {summary['steps_per_second']:,} steps/s"
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
    if not summary["finished"]:
        lines.append("go on with --resume")
    return "\n".join([*lines, f"results in {folder}"])
