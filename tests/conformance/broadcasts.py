"""The settings of the tests of memory: every environment, under every broadcast."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import pytest
from cases import (
    BIASED,
    CORRELATED,
    DRAWN,
    INPUT,
    JUMP,
    LOSSY,
    NOISY,
    OWN_ID,
    REMOTE,
    TOBIT,
    TRACKING,
    UNCENSORED,
    Options,
)
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.communication import BROADCASTS
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task

Array = NDArray[Any]
SETTINGS: dict[str, tuple[str, Options]] = {
    "oscillator": (TOBIT, {"filter": "tobit", "random_start": True}),
    "oscillator, paper": (TOBIT, {}),
    "oscillator, uncensored": (TOBIT, UNCENSORED),
    "correlated": (CORRELATED, {}),
    "markov": (JUMP, {}),
    "markov, centralised": (JUMP, {"filter": "centralised", "memory_filter": "imm"}),
    "input": (INPUT, DRAWN),
    "biased": (BIASED, {"access": "any"}),
    "biased target": (TRACKING, {"access": "any"}),
    "remote, losses": (REMOTE, LOSSY),
    "oscillator, departed": (TOBIT, {"filter": "tobit", "true_threshold_shift": 0.5} | NOISY),
    "correlated, departed": (CORRELATED, NOISY),
    "mine": (OWN_ID, {}),
}
ALIKE = ("oscillator, paper", "oscillator, uncensored", "markov, centralised", "biased target")


class Setting(NamedTuple):
    """An environment, what is broadcast in it, and whether there is memory."""

    name: str
    broadcast: str
    memory: bool

    @functools.cache  # noqa: B019  settings live as long as the tests
    def task(self, horizon: int = 50) -> Task:
        """The task; tokens are never short, so that what is asked for is granted."""
        env_id, options = SETTINGS[self.name]
        if not self.memory:
            options = {name: value for name, value in options.items() if name != "memory_filter"}
        common = {"tokens": "unlimited", "memory": self.memory, "broadcast": self.broadcast}
        return fusion_gym.make_task(env_id, horizon=horizon, **options | common)

    def __str__(self) -> str:
        return f"{self.name}, {self.broadcast}" + (", memory" if self.memory else "")


FED_BACK = (TOBIT, BIASED, TRACKING)


def _settings(memory: bool) -> list[Setting]:
    return [
        Setting(name, broadcast, memory)
        for name, (env_id, _) in SETTINGS.items()
        for broadcast in BROADCASTS
        if broadcast != "none" or env_id not in FED_BACK
    ]


WITH, ALL = _settings(True), _settings(True) + _settings(False)
DEAF = [setting for setting in ALL if setting.broadcast == "none"]
PARTLY = [s for s in ALL if s.broadcast == "estimate" and SETTINGS[s.name][0] not in FED_BACK]


def each(settings: list[Setting]) -> Any:
    """A test of each of them; those are slow that are much like another."""
    marked = [
        pytest.param(setting, marks=pytest.mark.slow)
        if setting.name in ALIKE or (not setting.memory and setting.broadcast == "packets")
        else setting
        for setting in settings
    ]
    return pytest.mark.parametrize("setting", marked, ids=str)


def begun(task: Task, seeds: list[int], owner: Owner = "own") -> EpisodeBatch:
    """Runs with these seeds, each at the start of an episode."""
    batch = EpisodeBatch(task, len(seeds), owner)
    batch.seed(np.arange(len(seeds)), seeds)
    batch.reset()
    return batch
