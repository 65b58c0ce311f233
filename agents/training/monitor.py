"""What watches a training: interrupts, validation, checkpoints, the split of the wall time."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.model import ModelPolicy

from .config import Experiment
from .constraint import score


class Interrupt:
    """Turns Ctrl-C and SIGTERM into a flag while it is entered; a second Ctrl-C gets through."""

    def __init__(self) -> None:
        self.raised = False

    def __enter__(self) -> Interrupt:
        self._before = {
            number: signal.signal(number, self._raise) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _raise(self, number: int, _: FrameType | None) -> None:
        self.raised = True
        signal.signal(number, self._before[signal.Signals(number)])


class Progress(BaseCallback):
    """Validation, best model, checkpoints, the progress bar and the split of the wall time."""

    def __init__(
        self,
        experiment: Experiment,
        folder: Path,
        task: Task,
        interrupt: Interrupt,
        bar: tqdm[Any],
        watch: Callable[[dict[str, Any]], bool] | None = None,
    ) -> None:
        super().__init__()
        self.watch, self.stopped = watch, False
        self.experiment, self.folder, self.task = experiment, folder, task
        self.interrupt, self.bar = interrupt, bar
        self.records = read_records(folder)
        self.target = experiment.training.target_rate
        self.best = max((score(r, self.target) for r in self.records), default=(-np.inf, -np.inf))
        self.seconds = {"environment": 0.0, "policy": 0.0, "update": 0.0, "validation": 0.0}
        self._mark = 0.0
        self._env_mark = 0.0
        self._next = 0

    def _on_training_start(self) -> None:
        self._next = self.num_timesteps + self.experiment.validation.every
        self._mark = time.perf_counter()

    def _on_rollout_start(self) -> None:
        now = time.perf_counter()
        self.seconds["update"] += now - self._mark
        self._mark, self._env_mark = now, self._environment().seconds

    def _on_step(self) -> bool:
        return not (self.interrupt.raised or self.stopped)

    def _on_rollout_end(self) -> None:
        environment = self._environment().seconds - self._env_mark
        now = time.perf_counter()
        self.seconds["environment"] += environment
        self.seconds["policy"] += now - self._mark - environment
        self._mark = now
        self.bar.update(self.num_timesteps - self.bar.n)
        if self.num_timesteps >= self._next:
            self._next += self.experiment.validation.every
            self.validate()
            self.save()
            now = time.perf_counter()
            self.seconds["validation"] += now - self._mark
            self._mark = now

    def _on_training_end(self) -> None:
        self.seconds["update"] += time.perf_counter() - self._mark

    def validate(self) -> None:
        """Run the validation episodes, log them, and keep the model if it is the best so far."""
        settings = self.experiment.validation
        policy = ModelPolicy(self.model, self.task, local=self.experiment.environment.local)
        found = run_episodes(self.task, policy, settings.episodes, settings.seed)
        record = {
            "timesteps": self.num_timesteps,
            "return": float((found.returns * self._weights()).mean()),
            "mse": float(found.mse.mean()),
            "rate": float(found.rate.mean()),
        }
        self.records.append(record)
        with (self.folder / "validation.jsonl").open("a") as file:
            file.write(json.dumps(record) + "\n")
        for key in ("return", "mse", "rate"):
            self.logger.record(f"validation/{key}", record[key])
        self.logger.dump(self.num_timesteps)
        self.bar.set_postfix(
            mse=f"{record['mse']:.4f}", rate=f"{record['rate']:.3f}", refresh=False
        )
        if score(record, self.target) > self.best:
            self.best = score(record, self.target)
            save(self.model, self.folder / "best_model.zip")
        if self.watch is not None:
            self.stopped = self.watch(record)

    def _weights(self) -> Array:
        """What each validation episode's return counts, by its price."""
        exponent = self.experiment.training.price_exponent
        if exponent == 0.0:
            return np.ones(1)
        episodes, first = self.experiment.validation.episodes, self.experiment.validation.seed
        batch = EpisodeBatch.seeded(self.task, episodes, first)
        return self.task.reward.price.scale(batch.price, exponent)

    def save(self) -> None:
        """Write the checkpoint, with the replay buffer where there is one."""
        if getattr(self.model, "replay_buffer", None) is not None:
            partial = self.folder / "latest_buffer.part.pkl"
            self.model.save_replay_buffer(partial)  # type: ignore[attr-defined]
            partial.replace(self.folder / "latest_buffer.pkl")
        save(self.model, self.folder / "latest.zip")

    def _environment(self) -> FusionSB3VecEnv:
        env = self.training_env.unwrapped
        assert isinstance(env, FusionSB3VecEnv)
        return env


def save(model: BaseAlgorithm, path: Path) -> None:
    """Save in one move, so that an interrupt never leaves half a file."""
    partial = path.with_name(path.stem + ".part.zip")
    model.save(partial)
    partial.replace(path)


def read_records(folder: Path) -> list[dict[str, float]]:
    """The validations written so far."""
    file = folder / "validation.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
