"""A learned front beside the committed rules of its classes, all on the same test episodes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from fusion_gym.core.task import Task
from fusion_gym.evaluation.envelope import EnvelopePoint, best_mse
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.base import Policy
from fusion_gym.policies.saved import saved_agent

from ..output.folders import check_inputs
from .committed import bound_of, measured, path_of, read_envelopes
from .config import Setting, load_suite
from .envelopes import Test, envelope_inputs, run_test
from .fronts import front_prices
from .workers import Work

# Beside the folder of the commands, in a clone as in an installed package.
SHIPPED = Path(__file__).parents[2] / "results"
PRICES = 7


@dataclass(frozen=True)
class Asked(Test):
    """An agent asked at a price; ``digest`` is the SHA-256 of its model's file."""

    model: Path
    digest: str
    price: float

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its result depends on: not where the model lies."""
        return super().inputs | {"model": self.digest}

    def make(self, task: Task) -> Policy:
        """The agent at its price."""
        return saved_agent(task, str(self.model), price=self.price)


@dataclass(frozen=True)
class Ground:
    """A setting with its committed envelopes, the bound and the rollout; and the test episodes.

    ``rollout`` are points on the first ``simulated`` of them.
    """

    setting: Setting
    envelopes: Mapping[str, Any]
    bound: dict[str, Any] | None
    rollout: Sequence[EnvelopePoint]
    simulated: int
    episodes: int
    seed: int

    @classmethod
    def read(cls, name: str, episodes: int) -> Ground:
        """That of one of the benchmark's settings, from the results that are shipped.

        Raises:
            ConfigurationError: a file that is absent, damaged or made from other settings.
        """
        suite = load_suite("benchmark")
        setting = next(setting for setting in suite.settings if setting.name == name)
        path = path_of(SHIPPED, name)
        envelopes = read_envelopes(path.parent)
        check_inputs(envelope_inputs(suite, setting), envelopes["inputs"], repr(str(path)))
        rollout, simulated = measured(path.parent)
        bound = bound_of(path.parent)
        return cls(setting, envelopes, bound, rollout, simulated, episodes, suite.seed)

    def rules(self, name: str) -> dict[str, Test]:
        """The rules of a class, by name."""
        return {
            vertex["name"]: Test(
                self.setting,
                tuple(vertex["options"].items()),
                vertex["policy"],
                self.episodes,
                self.seed,
            )
            for vertex in self.envelopes["classes"][name]["vertices"]
        }

    def agents(self, name: str, model: Path) -> list[Asked]:
        """An agent that belongs to a class, at prices over the whole range."""
        digest = hashlib.sha256(model.read_bytes()).hexdigest()
        options = tuple(self.envelopes["classes"][name]["options"].items())
        return [
            Asked(
                self.setting, options, f"agent at price {price:.4g}", self.episodes, self.seed,
                model, digest, price,
            )
            for price in front_prices(self.setting.price_range, PRICES)
        ]  # fmt: skip

    def single(self, name: str) -> list[tuple[float, float]]:
        """Rate and error of every tuned rule of a class, each as far from its envelope as on tuning
        episodes, which are easier or harder than those of the test."""
        content = self.envelopes["classes"][name]
        vertices = sorted(content["vertices"], key=lambda vertex: vertex["tuning"]["rate"])
        rates = [vertex["tuning"]["rate"] for vertex in vertices]
        harder = [v["test"]["mse"]["mean"] / v["tuning"]["mse"]["mean"] for v in vertices]
        return [
            (point["rate"], float(point["mse"] * np.interp(point["rate"], rates, harder)))
            for curve in self.envelopes["curves"]
            if curve["family"] in content["families"]
            and curve["options"] in ({}, content["options"])
            for point in curve["points"]
        ]

    def simulations(self, rules: Mapping[str, EpisodeResults]) -> list[tuple[float, float]]:
        """Rate and error of the rollout, its error as a share of these rules' on its episodes.

        Its few episodes are easier or harder than all of them by more than what it brings.
        """
        result = []
        for point in self.rollout if self.simulated <= self.episodes else ():
            below = best_mse(rules, point.rate)
            if below is not None:
                result.append(
                    (point.rate, point.mse / below[: self.simulated].mean() * below.mean())
                )
        return result


def measure(test: Test, work: Path) -> None:
    """Run a test, in a worker."""
    torch.set_num_threads(1)
    run_test(test, work)


class Trials(NamedTuple):
    """What is run on the test episodes: an agent at its prices, and the rules of its classes."""

    ground: Ground
    agent: Sequence[Asked]
    rules: Mapping[str, Mapping[str, Test]]
    work: Path

    @classmethod
    def of(cls, ground: Ground, classes: Sequence[str], folder: Path) -> Trials:
        """Those of an agent that was trained in the folder and is of the last of these classes."""
        return cls(
            ground,
            ground.agents(classes[-1], folder / "agent" / "best_model.zip"),
            {name: ground.rules(name) for name in classes},
            folder / "episodes",
        )

    def left(self) -> list[Work]:
        """What was not run before."""
        rules = [test for of in self.rules.values() for test in of.values()]
        every = {test.path(self.work): test for test in (*self.agent, *rules)}
        weight = 0.4 + 0.9 * self.ground.episodes / 1000
        return [
            Work(weight, measure, (test, self.work))
            for path, test in every.items()
            if not path.exists()
        ]

    def results(self, name: str) -> dict[str, EpisodeResults]:
        """The rules of a class, once they were run."""
        return {rule: test.read(self.work) for rule, test in self.rules[name].items()}

    def report(self) -> dict[str, Any]:
        """The agent at its prices beside the rules of each class at its own rates.

        A point has ``price``, ``rate``, ``mse`` and of each class the rules' ``mse`` and the paired
        ``difference`` to it, as a share of it, with its 95 % interval over episodes; nothing of a
        class whose rules all transmit more. ``mean`` is that of the differences at all prices.
        """
        learned = [test.read(self.work) for test in self.agent]
        points: list[dict[str, Any]] = [
            {
                "price": test.price,
                "rate": float(value.rate.mean()),
                "mse": mean_interval(value.mse)._asdict(),
                "rules": {},
            }
            for test, value in zip(self.agent, learned, strict=True)
        ]
        means = {}
        for name in self.rules:
            results, shares = self.results(name), []
            for point, value in zip(points, learned, strict=True):
                below = best_mse(results, point["rate"])
                if below is not None:
                    shares.append((value.mse - below) / below.mean())
                    point["rules"][name] = {
                        "mse": float(below.mean()),
                        "difference": mean_interval(shares[-1])._asdict(),
                    }
            if len(shares) == len(points):
                means[name] = mean_interval(np.mean(shares, axis=0))._asdict()
        ground = self.ground
        return {
            "setting": ground.setting.name,
            "env": ground.setting.environment.id,
            "options": ground.setting.environment.options,
            "episodes": ground.episodes,
            "seed": ground.seed,
            "model": self.agent[0].digest,
            "classes": {name: ground.envelopes["classes"][name]["sha256"] for name in self.rules},
            "points": points,
            "mean": means,
        }
