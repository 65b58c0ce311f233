"""Who knows what: the classes in which rules are tuned and agents are compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from fusion_gym.core.system import Knowledge, covers

from .config import Broadcast, Mode, Setting

KNOWS: dict[tuple[Mode, bool], Knowledge] = {
    ("centre", False): "centre",
    ("sensors", False): "coordinator",
    ("sensors", True): "coordinator_memory",
    ("local", False): "own",
    ("local", True): "own_memory",
}
_HEARD: tuple[Broadcast, ...] = ("none", "estimate", "packets")  # each tells all of those before


@dataclass(frozen=True)
class Class:
    """Who decides, whether it remembers, and what a sensor by itself hears (else None).

    ``options`` are those of the environment in which its rules see what the class knows.
    """

    mode: Mode
    memory: bool = False
    broadcast: Broadcast | None = None
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """For example ``sensors_memory`` or ``local_packets``."""
        parts = [self.mode, self.broadcast, "memory" if self.memory else None]
        return "_".join(part for part in parts if part)

    @property
    def knows(self) -> Knowledge:
        """What a rule of the class may know."""
        return KNOWS[self.mode, self.memory]

    def contains(self, other: Class) -> bool:
        """Whether whoever is of this class knows all that the other one does."""
        if not covers(self.knows, other.knows):
            return False
        if self.broadcast is None or other.broadcast is None:
            return True
        return _HEARD.index(other.broadcast) <= _HEARD.index(self.broadcast)


def classes_of(setting: Setting) -> Iterator[Class]:
    """All classes of a setting, each after those that it contains."""
    yield Class("centre")
    for broadcast in sorted(setting.broadcasts, key=_HEARD.index):
        heard = () if broadcast == setting.broadcasts[0] else (("broadcast", broadcast),)
        for memory in (False, True):
            remembered = (("memory", True),) if memory else ()
            yield Class("local", memory, broadcast, heard + remembered)
    for memory in (False, True):
        yield Class("sensors", memory, None, (("memory", True),) if memory else ())


def class_of(setting: Setting, mode: Mode) -> Class:
    """The class of an agent that remembers nothing, in the environment as the setting has it."""
    found = [c for c in classes_of(setting) if c.mode == mode and not c.options]
    return found[0]
