"""Train a Stable-Baselines3 agent on the native vector environment.

    python -m agents.train --config configs/tobit_oscillator_ppo.yaml [--resume]

Into the config's ``output`` folder go, as they are made: ``config.yaml``, ``latest.zip`` (the
checkpoint), ``best_model.zip`` (best return on the validation seeds), ``validation.jsonl``,
``tensorboard/`` and at the end ``final_model.zip`` and ``summary.json``. Ctrl-C and SIGTERM end
the training after the current step with a checkpoint; ``--resume`` goes on from there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure

from agents.config import Experiment, load_experiment, parse
from agents.constraint import TargetRate, score
from agents.models import make_model
from agents.monitor import Interrupt, Progress, save
from agents.progress import progress_bar
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.policies.model import ALGORITHMS
from fusion_gym.validation import ConfigurationError

# Training seeds lie far from the validation's and from the small numbers that tests use.
TRAINING_SEEDS = 1_000_000_000
# Algorithms that know no MultiBinary actions (the recurrent one fails on them while it trains).
DISCRETE_ONLY = ("dqn", "recurrent_ppo")


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
    earlier = load_experiment(file).model_dump(mode="json")
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
    if (
        name in DISCRETE_ONLY
        and not local
        and task.action != "discrete"
        and task.access != "single"
    ):
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
        model = ALGORITHMS[experiment.algorithm.name].load(checkpoint, env=env, device="cpu")
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
        progress_bar(
            experiment.training.timesteps, f"training {experiment.algorithm.name}", begun, quiet
        ) as bar,
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
    (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
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


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="python -m agents.train",
        description="Train a Stable-Baselines3 agent on the native vector environment.",
    )
    result.add_argument("--config", required=True, help="the experiment, see configs/")
    result.add_argument("--timesteps", type=int, help="instead of the config's")
    result.add_argument("--seed", type=int, help="instead of the config's")
    result.add_argument(
        "--target-rate", type=float, help="average transmissions per sensor and step to train to"
    )
    result.add_argument("--output", help="folder, instead of the config's")
    result.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    return result


def with_overrides(experiment: Experiment, arguments: argparse.Namespace) -> Experiment:
    """The config with what the command line says instead, checked again.

    Raises:
        ConfigurationError: a value that is not allowed.
    """
    plain = experiment.model_dump()
    for key in ("timesteps", "seed", "target_rate"):
        value = getattr(arguments, key)
        if value is not None:
            plain["training"][key] = value
    if arguments.output is not None:
        plain["output"] = arguments.output
    return parse(Experiment, plain, "command line")


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    arguments = parser().parse_args()
    try:
        experiment = with_overrides(load_experiment(arguments.config), arguments)
        summary = train(experiment, resume=arguments.resume)
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    if not summary["finished"]:
        sys.exit(130)


if __name__ == "__main__":
    main()
