"""What the rules share that look at what is believed."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from fusion_gym.core.beliefs import Beliefs
from fusion_gym.core.memory import Owner
from fusion_gym.core.system import Knowledge, Signals
from fusion_gym.core.task import Task
from fusion_gym.envs.views import SensorView
from fusion_gym.policies.base import Rule, parameter
from fusion_gym.validation import ConfigurationError, boolean, refusal


@dataclass
class BeliefRule(Rule):
    """A rule on what is believed: the scheduler's, or with ``own`` every sensor's by itself.

    ``together`` names the parameters that take more than one sensor to decide.
    """

    task: Task = field(repr=False)
    own: bool = parameter(False, boolean)
    together: ClassVar[tuple[str, ...]] = ("at_most",)

    def __post_init__(self) -> None:
        super().__post_init__()
        only = {name: getattr(self, name) for name in self.together}
        check_owner(self.task, self.own, **only)
        self.remember: Owner | None = "own" if self.own else "scheduler"

    @property
    def knowledge(self) -> Knowledge:
        """By the task's memory and by who decides."""
        return knows(self.task, self.own)

    def beliefs(self, signals: Signals) -> Beliefs:
        """The scheduler's beliefs, or every sensor's own."""
        return beliefs_of(signals, self.own)


def knows(task: Task, own: bool) -> Knowledge:
    """The class of a rule that looks at all that is believed, in a task with or without memory."""
    if task.memory:
        return "own_memory" if own else "scheduler_memory"
    return "own" if own else "scheduler"


def check_owner(task: Task, own: bool, **only_together: Any) -> None:
    """Whether a task lets its policies see the sensors, or every sensor decide by itself.

    ``only_together`` are parameters that take more than one sensor to decide: with ``own`` they
    must be ``None``, 0 or 1.

    Raises:
        ConfigurationError: it does not, or such a parameter beside ``own``.
    """
    if task.information != "sensors":
        raise ConfigurationError(
            f"information = {task.information!r} is not allowed with this rule: it must be "
            "'sensors', for it weighs the new measurements"
        )
    if not own:
        return
    SensorView(task)  # refuses what a sensor cannot do by itself
    for name, value in only_together.items():
        if value not in (None, 0, 1):
            raise refusal(name, value, "left out with own=True, for every sensor decides by itself")


def beliefs_of(signals: Signals, own: bool) -> Beliefs:
    """The scheduler's beliefs, or every sensor's own."""
    result: Any = signals["own_beliefs" if own else "beliefs"]
    beliefs: Beliefs = result
    return beliefs
