"""Functions that the rules on beliefs share."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.memory import Beliefs, Owner
from fusion_gym.core.task import Task
from fusion_gym.envs.views import SensorView
from fusion_gym.policies.base import Rule, parameter
from fusion_gym.validation import boolean, refusal


@dataclass
class BeliefRule(Rule):
    """A rule on the beliefs of the scheduler, or with ``own`` on the beliefs of each sensor.

    ``together`` names the parameters that compare sensors, which ``own`` excludes.
    """

    task: Task = field(repr=False)
    own: bool = parameter(False, boolean)
    together: ClassVar[tuple[str, ...]] = ("at_most",)

    def __post_init__(self) -> None:
        super().__post_init__()
        only = {name: getattr(self, name) for name in self.together}
        check_owner(self.task, self.own, **only)
        self.memory_owner: Owner | None = "own" if self.own else "scheduler"

    @property
    def knowledge(self) -> Knowledge:
        """The knowledge class, by the task's memory and by ``own``."""
        return knows(self.task, self.own)

    def beliefs(self, signals: Signals) -> Beliefs:
        """Return the beliefs of the scheduler, or of each sensor."""
        return beliefs_of(signals, self.own)


def knows(task: Task, own: bool) -> Knowledge:
    """Return the knowledge class of a rule on beliefs, in a task with or without memory."""
    if task.options.memory:
        return "own_memory" if own else "scheduler_memory"
    return "own" if own else "scheduler"


def check_owner(task: Task, own: bool, **only_together: Any) -> None:
    """Check that a task shows the measurements, and with ``own`` allows local decisions."""
    if task.options.information != "sensors":
        allowed = "'sensors', because it reads new measurements"
        raise refusal("information", task.options.information, allowed, "with this rule")
    if not own:
        return
    SensorView(task)  # refuses tasks without local decisions
    for name, value in only_together.items():
        if value not in (None, 0, 1):
            raise refusal(name, value, "left out with own=True, because sensors decide locally")


def beliefs_of(signals: Signals, own: bool) -> Beliefs:
    """Return the beliefs of the scheduler, or of each sensor."""
    result: Any = signals["own_beliefs" if own else "beliefs"]
    return result
