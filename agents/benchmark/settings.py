"""The settings of the benchmark as typed YAML, and the tasks of their classes."""

from pathlib import Path
from typing import Literal, get_args

import pydantic

from fusion_gym.core.knowledge import Knowledge
from fusion_gym.core.task import Task
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.rule_search import ClassName
from fusion_gym.training import config
from fusion_gym.training.config import (
    AnyAlgorithm,
    Positive,
    Rate,
    Share,
    Strict,
    checked,
    read_yaml,
)
from fusion_gym.validation import choice

CLASSES: tuple[ClassName, ...] = get_args(ClassName)
SuiteName = Literal["settings", "channels"]
FILE = Path(__file__).with_name("settings.yaml")


class Case(Strict):
    """Other options of a setting, and a factor of its token rate."""

    name: str
    options: Options = pydantic.Field(default_factory=dict)
    tokens: Rate = 1.0

    def __hash__(self) -> int:
        return hash(self.name)


class ThresholdRule(Strict):
    """A rule with one threshold, ``{value}`` in its text, between two ends.

    With a case the rule runs with other options than the setting's, such as another filter.
    """

    policy: str
    ends: tuple[Rate, Rate]
    case: Case | None = None


class Setting(Strict):
    """An environment with options, its own trigger, and the length of its trainings.

    ``printed`` is the trigger with the paper's parameters, ``headline`` the class of its knowledge.
    ``named_rules`` are tested by their titles like the trigger. ``prices`` has a list
    for each class, ``timesteps`` the length of a training by each of its algorithms, of which the
    first trains the agents. ``num_envs`` and ``error`` count without branches.
    ``optimum`` is a policy with ``{price}``.
    """

    name: str = pydantic.Field(pattern=r"^[a-z0-9_]+$")
    title: str
    environment: str
    options: Options
    trigger: ThresholdRule
    trigger_title: str
    printed: str | None = None
    headline: ClassName
    named_rules: dict[str, ThresholdRule] = pydantic.Field(default_factory=dict)
    classes: tuple[ClassName, ...] = CLASSES
    prices: dict[ClassName, list[Rate]]
    agent_options: Options = pydantic.Field(default_factory=dict)
    memory: bool = True
    optimum: str | None = None
    timesteps: dict[ClassName, dict[str, Positive]]
    num_envs: Positive = 1024
    error: Literal["squared", "excess", "mismatch"] = "mismatch"
    cases: tuple[Case, ...] = ()

    @property
    def calibrated(self) -> bool:
        """Whether agents are calibrated: they have a logit for each sensor."""
        return self.options.get("access") != "assignment"

    def has_memory(self, name: ClassName) -> bool:
        """Return whether the policies of a class have memory."""
        return self.memory and name != "centre"

    def task(self, name: ClassName, case: Case | None = None) -> Task:
        """Return the task of a class's rules."""
        options = self.options | ({"memory": True} if self.has_memory(name) else {})
        return make_task(self.environment, **_perturbed(options, case))

    def agent_environment(
        self, name: ClassName, price_range: tuple[float, float], case: Case | None = None
    ) -> Options:
        """Return the environment options of an agent of a class."""
        options = self.options | self.agent_options
        options |= {"cost_weight": "random", "price_range": list(price_range)}
        if name == "centre":
            options["information"] = "centre"
        elif self.has_memory(name):
            options["memory"] = True
        else:
            options["belief_features"] = ["value"]
        return _perturbed(options, case)


class Suite(Strict):
    """The whole benchmark; ``steps`` multiplies the lengths of all trainings."""

    title: str
    command: str
    episodes: Positive
    tuning_episodes: tuple[Positive, Positive]
    calibration_episodes: tuple[Positive, Positive]
    case_episodes: Positive
    generations: Positive
    training_seeds: Positive
    shares: tuple[Share, ...]
    algorithms: tuple[AnyAlgorithm, ...]
    steps: Rate = 1.0
    rules: tuple[ThresholdRule, ...]
    cases: tuple[Case, ...]
    settings: tuple[Setting, ...]

    def cases_of(self, setting: Setting) -> tuple[Case, ...]:
        """Return the perturbed cases of a setting."""
        return setting.cases or self.cases

    def experiment(
        self,
        setting: Setting,
        name: ClassName,
        prices: tuple[float, ...],
        seed: int,
        algorithm: str,
        rule: str,
    ) -> config.Experiment:
        """Return the training of one agent at random prices, from a rule if it branches."""
        (settings,) = (item for item in self.algorithms if item.name == algorithm)
        timesteps = max(round(setting.timesteps[name][algorithm] * self.steps), 1)
        training = config.TrainingConfig(
            timesteps=timesteps,
            num_envs=setting.num_envs,
            seed=seed,
            price_exponent=0.8,
            error=setting.error,
        )
        if isinstance(settings, config.BranchingConfig):
            settings = settings.model_copy(update={"rule": rule})
            training = config.TrainingConfig(timesteps=timesteps, num_envs=128, seed=seed)
        return config.Experiment(
            environment=config.EnvironmentConfig(
                id=setting.environment,
                options=setting.agent_environment(name, (min(prices), max(prices))),
                local=name == "local",
            ),
            algorithm=settings,
            training=training,
            validation=config.ValidationConfig(every=max(timesteps // 3, 1), episodes=256),
            calibration=None,
            output="agent",
        )


def load_suite(
    quick: bool = False, settings: tuple[str, ...] = (), name: SuiteName = "settings"
) -> Suite:
    """Return a suite, or its quick version, with the named settings or all."""
    file = FILE.with_stem(name)
    content = read_yaml(file)
    changes = content.pop("quick")
    by_name = {setting["name"]: setting for setting in content["settings"]}
    for setting in settings:
        choice("settings", setting, by_name)
    usual = changes.pop("settings", by_name) if quick else by_name
    content["settings"] = [by_name[setting] for setting in settings or usual]
    return checked(Suite, content | (changes if quick else {}), f"config {str(file)!r}")


def knowledge_of(setting: Setting, name: ClassName) -> Knowledge:
    """Return the knowledge class of a class's policies."""
    if name == "centre":
        return "centre"
    memory = setting.has_memory(name)
    if name == "local":
        return "own_memory" if memory else "own"
    return "scheduler_memory" if memory else "scheduler"


def _perturbed(options: Options, case: Case | None) -> Options:
    if case is None:
        return options
    return options | case.options | {"token_rate": options["token_rate"] * case.tokens}
