"""What is trained in a setting, what it is compared with, and where all of that is."""

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import EnvelopePoint
from fusion_gym.validation import ConfigurationError, choice

from ..output.files import read_json
from ..output.folders import check_inputs
from ..training.checked import load_checked, parse
from ..training.config import EnvironmentConfig, Experiment, TrainingConfig, ValidationConfig
from .committed import hull_of, present, read_envelopes
from .config import Setting, Suite
from .envelopes import Test, envelope_task
from .fronts import Points, front_prices, is_below
from .jobs import training_of
from .learning import Course, Learning
from .verdict import MIDDLE

Kind = Literal["front", "plain"]
SOLVED = ("optimum", "schedules")  # compared by costs
# Options that change neither the task nor what a policy may know of it: rules see the time anyway.
_FREE = ("memory_filter", "belief_features", "clock")


@dataclass(frozen=True)
class Study:
    """A course and where its files are: ``results`` holds the committed ones."""

    learning: Learning
    suite: Suite
    course: Course
    results: Path
    output: Path
    work: Path

    @property
    def setting(self) -> Setting:
        """The suite's setting.

        Raises:
            ConfigurationError: there is none of that name.
        """
        by_name = {setting.name: setting for setting in self.suite.settings}
        return by_name[choice("setting", self.course.setting, by_name)]

    @property
    def prices(self) -> list[float]:
        """The prices that every front is asked for."""
        return front_prices(self.setting.price_range, self.learning.prices)

    @property
    def inner(self) -> list[bool]:
        """Which prices lie in the inner part of the range, in the logarithm."""
        low, high = self.setting.price_range
        price = Price(None, (low, high))
        first, last = self.learning.inner
        places = price.encode(np.array(self.prices)).tolist()
        return [first <= place <= last for place in places]

    @property
    def episodes(self) -> int:
        """Test episodes."""
        return self.learning.test_episodes or self.suite.episodes

    @property
    def report(self) -> Path:
        """The table for readers that is written last."""
        return self.output / self.setting.name / "learning.csv"

    @property
    def throughput(self) -> Path:
        """The JSON of this machine's steps per second."""
        return self.work / self.setting.name / "throughput.json"

    @functools.cached_property
    def envelopes(self) -> dict[str, Any]:
        """The committed file of the setting's envelopes."""
        present(self.suite, self.setting, self.results)  # made from what the suite says now
        return read_envelopes(self.results / self.setting.name)

    def envelope(self, name: str) -> dict[str, Any]:
        """A class of the committed envelopes.

        Raises:
            ConfigurationError: there is none of that name.
        """
        classes = self.envelopes["classes"]
        return classes[choice("class", name, classes)]

    @property
    def classes(self) -> list[str]:
        """The classes of the committed envelopes that it is compared with."""
        own = [] if self.solved else [self.course.against]
        return own + ([self.course.memoryless] if self.course.memoryless else [])

    @property
    def memoryless(self) -> list[EnvelopePoint] | None:
        """The envelope to get below while learning, as it was measured on the test seeds."""
        name = self.course.memoryless
        return None if name is None else hull_of(self.envelope(name))

    def below(self, front: Points) -> bool:
        """Whether a front is below the rules without memory; it counts from the middle's begin."""
        if self.memoryless is None:
            return False
        return is_below(front, self.memoryless, MIDDLE[0] * self.envelopes["always"])

    @property
    def solved(self) -> bool:
        """Whether the finished front is compared with an optimum, by costs."""
        return self.course.against in SOLVED

    @property
    def vertices(self) -> list[dict[str, Any]]:
        """The vertices of the envelope that the finished front is compared with, if it is one."""
        own = self.course.against
        return list(self.envelope(own)["vertices"]) if own in self.classes else []

    @property
    def tests(self) -> list[Test]:
        """What the finished front is compared with, to be run on the test episodes."""

        def test(policy: str, options: dict[str, Any]) -> Test:
            return Test(
                self.setting, tuple(options.items()), policy, self.episodes, self.suite.seed
            )

        free = {"cost_weight": 0.0}  # what was spent is counted at each price
        if self.course.against == "optimum":
            return [test(f"optimal:price={price!r}", free) for price in self.prices]
        if self.course.schedules:
            return [test(policy, free) for policy in self.course.schedules]
        return [test(vertex["policy"], vertex["options"]) for vertex in self.vertices]

    def experiment(self, kind: Kind, seed: int) -> Experiment:
        """The training of one seed, with the measurements' spacing.

        Raises:
            ConfigurationError: a config that is not allowed.
        """
        if kind == "front":
            value, every = load_checked(Experiment, self.course.front, "front"), self.learning.every
        else:
            value = self._plain()
            every = self.learning.plain.every
        plain = value.model_dump()
        plain["validation"]["every"] = every
        plain["training"] |= {"seed": seed, "threads": 1}
        plain["training"]["timesteps"] = self.learning.timesteps or value.training.timesteps
        plain["output"] = str(self.work / self.setting.name / f"{kind}_{seed}")
        return parse(Experiment, plain, self.course.front, "front")

    def _plain(self) -> Experiment:
        """Plain PPO's training: without memory, on the squared error, at the suite's prices."""
        setting, plain, course = self.setting, self.learning.plain, self.course
        own = setting.price_exponent
        priced = {"cost_weight": "random", "price_range": list(setting.price_range)}
        return Experiment(
            environment=EnvironmentConfig(
                id=setting.environment.id, options=setting.environment.options | priced
            ),
            algorithm=self.learning.algorithm_of(course),
            training=TrainingConfig(
                timesteps=round(plain.timesteps * course.plain.longer),
                num_envs=plain.num_envs,
                price_exponent=self.suite.price_exponent if own is None else own,
            ),
            validation=ValidationConfig(episodes=512),
            output=str(self.work),
        )

    def task(self) -> Task:
        """What a finished front is tested in: its own environment, without a price in sight.

        Where costs are compared tokens are free of charge, and counted at each price.
        """
        where = load_checked(Experiment, self.course.front, "front").environment
        priced = ("cost_weight", "price_range")
        own = {key: value for key, value in where.options.items() if key not in priced}
        return make_task(where.id, **(own | ({"cost_weight": 0.0} if self.solved else {})))

    def check(self) -> None:
        """Whether the front knows what it is compared with: neither less nor more.

        Raises:
            ConfigurationError: another environment, setting or class; names the first difference.
        """
        where = load_checked(Experiment, self.course.front, "front").environment
        options: dict[str, Any] = {}
        local, free = False, set(_FREE)
        if self.course.against == "schedules":
            options = {"information": "centre"}
        elif self.course.against == "optimum":
            free.add("memory")  # it knows the errors themselves
        else:
            compared = self.envelope(self.course.against)
            options, local = compared["options"], compared["mode"] == "local"
        expected = {"id": self.setting.environment.id, "local": local}
        expected |= envelope_task(self.setting, options.items()).settings
        value = {"id": where.id, "local": where.local} | self.task().settings
        expected |= {"cost_weight": "random", "price_range": list(self.setting.price_range)}
        value |= {key: where.options.get(key) for key in ("cost_weight", "price_range")}
        for key in dict.fromkeys([*expected, *value]):
            if key not in free and value.get(key) != expected.get(key):
                raise ConfigurationError(
                    f"front = {self.course.front!r}: {key} = {value.get(key)!r} is not allowed in "
                    f"{self.setting.name}: what it is compared with has {expected.get(key)!r}"
                )


class Lesson(NamedTuple):
    """The training of one seed in a study; ``budget`` in processor seconds ends a plain one."""

    study: Study
    kind: Kind
    seed: int
    budget: float = math.inf

    @property
    def experiment(self) -> Experiment:
        """What is trained."""
        return self.study.experiment(self.kind, self.seed)

    @property
    def path(self) -> Path:
        """The JSON of what it taught."""
        return self.study.work / self.study.setting.name / f"{self.kind}_{self.seed}.json"

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its result depends on, the budget apart."""
        study, course = self.study, self.study.course
        return {
            "training": training_of(self.experiment),
            "course": course.model_dump(mode="json"),
            "prices": study.prices,
            "episodes": study.learning.episodes,
            "test": {"episodes": study.episodes, "seed": study.suite.seed},
            "envelopes": {name: study.envelope(name)["sha256"] for name in study.classes},
        }

    def result(self) -> dict[str, Any] | None:
        """What it taught, if it is finished.

        Raises:
            ConfigurationError: the file is damaged, or was made from other inputs.
        """
        if not self.path.exists():
            return None
        content = read_json(self.path, "work")
        check_inputs(self.inputs, content.get("inputs"), repr(str(self.path)))
        return content
