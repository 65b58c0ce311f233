"""Checkpoints, validations and the callbacks of a training.

A checkpoint, one file, is the archive of Stable-Baselines3 with further parts: the states of all
random generators, the running episodes, the memory of a recurrent policy, the replay buffer, the
best model so far and the journal. One file can be replaced atomically. The states and the archive's
entries are pickles. Load only checkpoints of your own trainings.
"""

from __future__ import annotations

import functools
import io
import json
import pickle
import random
import signal
import threading
import time
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import NamedTuple, TypedDict

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from fusion_gym.arrays import Array
from fusion_gym.core.scale import sustained_tokens
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain, State
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.evaluation.episodes import run_priced
from fusion_gym.evaluation.rule_search import class_of, search_of_class
from fusion_gym.output import files
from fusion_gym.output.progress import Bar
from fusion_gym.policies.saved import DAMAGE, ENTRY, ModelPolicy, ModelView
from fusion_gym.training.config import Experiment
from fusion_gym.validation import ConfigurationError

DAMAGED = (*DAMAGE, KeyError, TypeError, ValueError)  # errors from a damaged checkpoint
# Additional entries of the archive.
_JOURNAL, _STATE, _BEST = "journal.json", "state.pkl", "best_model.zip"
# Attributes that Stable-Baselines3 does not save: replay buffer and recurrent memory.
_LEFT_OUT = ("replay_buffer", "_last_lstm_states")
_ACTIVITIES = ("environment", "policy", "update", "validation")


ValidationRecord = TypedDict(
    "ValidationRecord",
    {
        "timesteps": int,
        "return": float,
        "mse": float,
        "rate": float,
        "relative_cost": float,
        "prices": list[dict[str, float]],
    },
)


@dataclass
class Journal:
    """The progress of a training.

    Args:
        inputs: inputs of the training.
        records: its validations.
        seconds: wall time by activity, over all parts of the training.
        cpu_seconds: processor time without validation, over all parts of the training.
        best: file of the best model.
    """

    inputs: Plain
    records: list[ValidationRecord] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_ACTIVITIES, 0.0))
    cpu_seconds: float = 0.0
    best: bytes | None = None


def save_checkpoint(
    path: Path, model: BaseAlgorithm, env: FusionSB3VecEnv, journal: Journal
) -> None:
    """Write the checkpoint between two rollouts; it does not include a rollout in progress."""
    content = asdict(journal)
    best = content.pop("best")
    with files.replacing(path) as partial:
        model.save(partial)
        with zipfile.ZipFile(partial, "a") as archive:
            archive.writestr(_JOURNAL, json.dumps(content))
            if best is not None:
                archive.writestr(_BEST, best)
            with archive.open(_STATE, "w", force_zip64=True) as file:
                pickle.dump(_state(model, env), file, pickle.HIGHEST_PROTOCOL)


def read_journal(path: Path) -> Journal:
    """Return the journal of a checkpoint after a check of all checksums, without unpickling."""
    try:
        with zipfile.ZipFile(path) as archive:
            if broken := archive.testzip():
                raise zipfile.BadZipFile(f"{broken} is damaged")
            content = json.loads(archive.read(_JOURNAL))
            best = archive.read(_BEST) if _BEST in archive.namelist() else None
        return Journal(**content, best=best)
    except DAMAGED as error:
        reason = " ".join(str(error).split()).strip("'\"")
        raise ConfigurationError(
            f"checkpoint = {str(path)!r} cannot be continued: {reason}"
        ) from None


def restore(path: Path, kind: type[BaseAlgorithm], env: FusionSB3VecEnv) -> BaseAlgorithm:
    """Return the model of a checkpoint, and restore the environment and all random generators."""
    model = kind.load(path, env=env, device="cpu", force_reset=False)
    with zipfile.ZipFile(path) as archive, archive.open(_STATE) as file:
        state = pickle.load(file)
    env.restore(state["env"])
    for name, value in state["model"].items():
        setattr(model, name, value)
    # Last, because loading a model seeds them.
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    model.action_space.np_random.bit_generator.state = state["actions"]
    return model


def _state(model: BaseAlgorithm, env: FusionSB3VecEnv) -> State:
    """Return the state of a training that Stable-Baselines3 does not save."""
    return {
        "env": env.snapshot(),
        "model": {name: vars(model)[name] for name in _LEFT_OUT if name in vars(model)},
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002
        "torch": torch.get_rng_state(),
        "actions": model.action_space.np_random.bit_generator.state,
    }


PRICES = 5  # of a validation over a range, evenly spaced on a logarithmic scale


class Callback(BaseCallback):
    """A callback between rollouts, with access to the training's environment."""

    @property
    def environment(self) -> FusionSB3VecEnv:
        """The environment without wrappers."""
        env = self.training_env.unwrapped
        assert isinstance(env, FusionSB3VecEnv)
        return env

    def _on_step(self) -> bool:
        return True


class Traffic(Callback):
    """Logs the rates of requests and grants in a rollout, and the policy's entropy per sensor.

    Rates are per sensor and step. The entropy, in nats, is from the update before the rollout, for
    algorithms that report it.
    """

    def _on_rollout_start(self) -> None:
        env = self.environment
        self._mark = env.requests, env.totals[1]
        lost = self.logger.name_to_value.get("train/entropy_loss")
        if lost is not None:
            deciding = 1 if env.num_envs > env.runs else env.task.sensors
            self.logger.record("train/entropy_per_sensor", -lost / deciding)

    def _on_rollout_end(self) -> None:
        env = self.environment
        (requested, granted), steps = self._mark
        chances = env.task.sensors * (env.totals[1] - steps)
        if chances > 0:
            self.logger.record_mean("rollout/requested", (env.requests[0] - requested) / chances)
            self.logger.record_mean("rollout/granted", (env.requests[1] - granted) / chances)


class PriceRecord(NamedTuple):
    """An agent at a price of a token: means per step of its likeliest and of drawn actions."""

    price: float
    cost: float
    tokens: float
    mse: float
    rate: float
    drawn_cost: float
    drawn_tokens: float
    drawn_mse: float


def run_at_prices(
    model: BaseAlgorithm, task: Task, local: bool, prices: Sequence[float], episodes: int, seed: int
) -> list[PriceRecord]:
    """Run the model's likeliest and drawn actions at each price, on the same episodes."""
    count = max(1, episodes // len(prices))
    each, numbers = np.repeat(prices, count), seed + np.tile(np.arange(count), len(prices))
    columns: list[Array] = [np.array(prices)]
    for deterministic in (True, False):
        trained = ModelView(local=local, rule=getattr(model, ENTRY).get("rule"))
        policy = ModelPolicy(model, task, deterministic, trained=trained)
        means = run_priced(task, policy, numbers, each)
        columns += [means.cost(each), means.tokens, means.mse]
        columns += [means.rate.mean(-1)] if deterministic else []
    rows = np.transpose([column.reshape(len(prices), -1).mean(1) for column in columns])
    return [PriceRecord(*row) for row in rows.tolist()]


def prices_of(task: Task) -> tuple[float, ...]:
    """Return prices over the range of a drawn price, or the task's own price."""
    price = task.reward.price
    if price.fixed is not None or price.span is None:
        return (price.middle,)
    return tuple(np.geomspace(*price.span, PRICES).tolist())


def threshold_costs(task: Task, local: bool, prices: Sequence[float]) -> Array:
    """Return the cost of the best single threshold of the class at each price; 1 at one price."""
    if len(prices) == 1:
        return np.ones(1)
    search = search_of_class(class_of(task, local), task, prices, generations=1, episodes=(16, 16))
    return search.start_costs(search.start)


def warn_of_silence(records: Sequence[PriceRecord]) -> None:
    """Warn where the likeliest action spends less than half of the tokens of drawn actions."""
    silent = [row for row in records if row.tokens < 0.5 * row.drawn_tokens]
    if silent:
        row = min(silent, key=lambda row: row.tokens / row.drawn_tokens)
        warnings.warn(
            f"at {len(silent)} of {len(records)} prices the likeliest action spends less than half "
            f"of the tokens of drawn actions (at {row.price:.4g}: {row.tokens:.3g} of "
            f"{row.drawn_tokens:.3g} per step): fusion-gym calibrate corrects it",
            stacklevel=2,
        )


def warn_of_unused_tokens(task: Task, tokens: float) -> None:
    """Warn if an agent spends less than half of the sustained tokens at its lowest price."""
    sustained = sustained_tokens(task)
    share = tokens / sustained if sustained else 1.0
    if share < 0.5 and not task.network.bucket.unlimited:
        warnings.warn(
            f"at its lowest price the agent spends {share:.0%} of the tokens that the bucket "
            "sustains: a lower price, or a reward_scale above the present "
            f"{task.settings.get('reward_scale')}, lets it use more",
            stacklevel=2,
        )


class Interrupt:
    """Turns Ctrl-C and SIGTERM into a flag inside the context; a second Ctrl-C interrupts.

    Outside the main thread, as in the workers of a cluster, signals are not handled.
    """

    def __init__(self) -> None:
        self.raised = False

    def __enter__(self) -> Interrupt:
        mine = threading.current_thread() is threading.main_thread()
        numbers = (signal.SIGINT, signal.SIGTERM) if mine else ()
        self._before = {number: signal.signal(number, self._raise) for number in numbers}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _raise(self, number: int, _: FrameType | None) -> None:
        self.raised = True
        signal.signal(number, self._before[signal.Signals(number)])


class Stop(Exception):
    """Ends a training between two rollouts, where the model has learned from all counted steps."""


class Progress(Callback):
    """Validates, saves the best model and checkpoints, and shows progress and wall time."""

    def __init__(
        self,
        experiment: Experiment,
        folder: Path,
        task: Task,
        interrupt: Interrupt,
        bar: Bar,
        journal: Journal,
    ) -> None:
        super().__init__()
        self.experiment, self.folder, self.task = experiment, folder, task
        self.interrupt, self.bar, self.journal = interrupt, bar, journal
        self.best = min((record["relative_cost"] for record in journal.records), default=np.inf)
        self._mark = _now()
        self._env_mark = 0.0
        self._next = 0
        self._due = False  # whether a checkpoint follows the next update
        self._write_records()
        if journal.best is not None:
            self._write_best(journal.best)
        if journal.records:
            bar.say(log_line(journal.records[-1]))

    def _on_training_start(self) -> None:
        self._plan()
        self._mark = _now()

    def _on_rollout_start(self) -> None:
        self._measure("update")
        if self.interrupt.raised:
            raise Stop
        if self._due:
            self._due = False
            self.save()
            self._measure("validation")
        self._env_mark = self.environment.seconds

    def _on_rollout_end(self) -> None:
        environment = self.environment.seconds - self._env_mark
        self._measure("policy")
        self.journal.seconds["policy"] -= environment
        self.journal.seconds["environment"] += environment
        self.bar.reach(self.num_timesteps)
        # The finished model has the last validation.
        if self._next <= self.num_timesteps < self.experiment.training.timesteps:
            self._plan()
            self._due = True
            self.validate()
            self._measure("validation")

    def _on_training_end(self) -> None:
        self._measure("update")

    def _measure(self, activity: str) -> None:
        """Add the time since the last call to an activity."""
        now = _now()
        self.journal.seconds[activity] += now[0] - self._mark[0]
        if activity != "validation":
            self.journal.cpu_seconds += now[1] - self._mark[1]
        self._mark = now

    def _plan(self) -> None:
        """Set the next validation to the next multiple of the steps between two validations."""
        every = self.experiment.validation.every
        self._next = (self.num_timesteps // every + 1) * every

    def finish(self) -> None:
        """Validate the finished model, unless its last validation did."""
        records = self.journal.records
        if not records or records[-1]["timesteps"] < self.num_timesteps:
            self._mark = _now()
            self.validate()
            self._measure("validation")

    def validate(self) -> None:
        """Run the validation episodes, log them, and save the model if it is the best so far.

        The best has the least mean over the prices of its cost relative to a single threshold's.
        """
        settings, local = self.experiment.validation, self.experiment.environment.local
        rows = run_at_prices(
            self.model, self.task, local, self.prices, settings.episodes, settings.seed
        )
        means = PriceRecord(*np.mean(rows, axis=0).tolist())
        costs = np.array([row.cost for row in rows])
        scale = self.task.reward.price.scale(
            np.array(self.prices), self.experiment.training.price_exponent
        )
        record: ValidationRecord = {
            "timesteps": self.num_timesteps,
            "return": -self.task.horizon * float((scale * costs).mean()),
            "mse": means.mse,
            "rate": means.rate,
            "relative_cost": float((costs / self.references).mean()),
            "prices": [row._asdict() for row in rows],
        }
        if record["relative_cost"] < self.best:
            self.best = record["relative_cost"]
            file = io.BytesIO()
            self.model.save(file)
            self.journal.best = file.getvalue()
            self._write_best(self.journal.best)
        self.journal.records.append(record)
        self._write_records()
        for key, number in record.items():
            if key not in ("timesteps", "prices"):
                self.logger.record(f"validation/{key}", number)
        self.logger.record("validation/cpu_seconds", self.journal.cpu_seconds)
        for row in rows:
            for key, value in row._asdict().items():
                if key != "price":
                    self.logger.record(f"validation/{key}_price_{row.price:.3g}", value)
        self.logger.dump(self.num_timesteps)
        self.bar.say(log_line(record))

    @property
    def last(self) -> list[PriceRecord]:
        """The last validation."""
        return [PriceRecord(**row) for row in self.journal.records[-1]["prices"]]

    def _write_best(self, content: bytes) -> None:
        with files.replacing(self.folder / "best_model.zip") as partial:
            partial.write_bytes(content)

    def _write_records(self) -> None:
        lines = [json.dumps(record) + "\n" for record in self.journal.records]
        files.write_text(self.folder / "validation.jsonl", "".join(lines))

    @functools.cached_property
    def prices(self) -> tuple[float, ...]:
        """The prices of a token in validations."""
        return prices_of(self.task)

    @functools.cached_property
    def references(self) -> Array:
        """The cost of the best single threshold at each price."""
        return threshold_costs(self.task, self.experiment.environment.local, self.prices)

    def save(self) -> None:
        """Write the checkpoint."""
        save_checkpoint(self.folder / "latest.zip", self.model, self.environment, self.journal)


def log_line(record: ValidationRecord) -> str:
    """Return a validation in a few words."""
    return f"MSE {record['mse']:.4f}, rate {record['rate']:.3f}"


def _now() -> tuple[float, float]:
    """Return seconds of wall time, and of this process on all processors."""
    return time.perf_counter(), time.process_time()
