"""Who knows what: the classes in which rules are tuned and agents are compared."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, get_args

from agents.benchmark.config import Broadcast, Mode, Packet, Setting, Suite
from fusion_gym.core.communication import FEATURES
from fusion_gym.core.system import Knowledge, covers
from fusion_gym.validation import choice

KNOWS: dict[tuple[Mode, bool], Knowledge] = {
    ("centre", False): "centre",
    ("sensors", False): "scheduler",
    ("sensors", True): "scheduler_memory",
    ("local", False): "own",
    ("local", True): "own_memory",
}
HEARD: tuple[Broadcast, ...] = ("none", "estimate", "packets")  # each tells all of those before
Options = tuple[tuple[str, Any], ...]


class Class(NamedTuple):
    """Who decides, whether it remembers, what a sensor by itself hears (else None), and what a
    packet holds.

    ``options`` are those of the environment in which its rules see what the class knows.
    """

    mode: Mode
    memory: bool = False
    broadcast: Broadcast | None = None
    options: Options = ()
    packet: Packet = "measurement"

    @property
    def name(self) -> str:
        """For example ``sensors_memory``, ``local_packets`` or ``sensors_estimates_memory``."""
        held = "estimates" if self.packet == "estimate" else None
        parts = [self.mode, self.broadcast, held, "memory" if self.memory else None]
        return "_".join(part for part in parts if part)

    @property
    def world(self) -> Options:
        """The options in which rules are tuned that look neither at memory nor at what is heard.

        Packets that hold the estimate take a scheduler that remembers.
        """
        return () if self.packet == "measurement" else self.options

    @property
    def information(self) -> dict[str, Any]:
        """The options of the environment in which an agent sees what the class knows.

        Rules that remember nothing look at what a packet would change too, so agents are shown it.
        """
        if self.mode == "centre":
            return dict(self.options) | {"information": "centre"}
        visible = {} if self.memory else {"belief_features": list(FEATURES)}
        return dict(self.options) | visible

    @property
    def knows(self) -> Knowledge:
        """What a rule of the class may know."""
        return KNOWS[self.mode, self.memory]

    def contains(self, other: Class) -> bool:
        """Whether whoever is of this class knows all that the other one does, of such packets."""
        if self.packet != other.packet or not covers(self.knows, other.knows):
            return False
        if self.broadcast is None or other.broadcast is None:
            return True
        return HEARD.index(other.broadcast) <= HEARD.index(self.broadcast)


def classes_of(setting: Setting) -> Iterator[Class]:
    """All classes of a setting, each after those that it contains."""
    yield Class("centre")
    for broadcast in sorted(setting.broadcasts, key=HEARD.index):
        received = () if broadcast == setting.broadcasts[0] else (("broadcast", broadcast),)
        for memory in (False, True):
            remembers = (("memory", True),) if memory else ()
            yield Class("local", memory, broadcast, received + remembers)
    for memory in (False, True):
        yield Class("sensors", memory, None, (("memory", True),) if memory else ())
    if setting.estimates:
        memory_posterior = (("packet", "estimate"), ("memory", True))
        yield Class("sensors", True, None, memory_posterior, "estimate")


def trained_classes(suite: Suite, setting: Setting) -> list[Class]:
    """The classes of a setting in which the suite trains agents.

    Raises:
        ConfigurationError: ``agents``, ``envs`` or ``lengths`` of the setting name none of its
            classes (or modes).
    """
    every = {c.name: c for c in classes_of(setting)}
    for field in ("envs", "lengths"):
        for name in getattr(setting, field):
            choice(f"{field} of {setting.name}", name, [*get_args(Mode), *every])
    own = list(every) if setting.agents is None else setting.agents
    for name in own:
        choice(f"agents of {setting.name}", name, every)
    classes = own if suite.classes is None else suite.classes
    return [c for name, c in every.items() if name in own and name in classes]


def names_of(suite: Suite) -> list[str]:
    """The names of all classes, of all settings."""
    return list(dict.fromkeys(c.name for setting in suite.settings for c in classes_of(setting)))
