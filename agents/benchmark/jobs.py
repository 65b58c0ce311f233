"""Jobs of the benchmark: frozen dataclasses whose fields determine the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

import pydantic

from agents.benchmark.settings import Setting
from agents.cache import Cache
from agents.workers import Call, Pool, run_parallel
from fusion_gym.entries import Plain
from fusion_gym.evaluation.rule_search import ClassName
from fusion_gym.output.files import fingerprint

AnyJob = TypeVar("AnyJob", bound="AnyInputs")
Result = TypeVar("Result")
_PLAIN: pydantic.TypeAdapter[Any] = pydantic.TypeAdapter(Any)


class AnyInputs(Protocol):
    """What a runner needs of a job."""

    @property
    def inputs(self) -> Plain:
        """The key of its result."""
        ...

    @property
    def weight(self) -> float:
        """About its seconds on one core."""
        ...


@dataclass(frozen=True)
class Job:
    """A job in a class of a setting; ``weight`` is about its seconds on one core.

    A field with the metadata ``key`` false has no effect on the result.
    """

    setting: Setting
    name: ClassName
    weight: ClassVar[float] = 30.0

    @property
    def inputs(self) -> Plain:
        """Return its fields as plain data: the key of its result."""
        return {
            field.name: _PLAIN.dump_python(getattr(self, field.name), mode="json")
            for field in fields(self)
            if field.metadata.get("key", True)
        }


@dataclass(frozen=True)
class Runner:
    """The folder of results, and the processes that compute missing ones."""

    folder: Path
    pool: Pool

    @property
    def cache(self) -> Cache:
        """Results in the folder."""
        return Cache(self.folder / "jobs")

    def run(
        self, work: Callable[[AnyJob], Result], jobs: Sequence[AnyJob], title: str
    ) -> list[Result]:
        """Return the results of jobs in their order, from the folder or computed."""
        every = {fingerprint(job.inputs): job for job in jobs}
        calls = [
            Call(job.weight, self.cache.call, (work, job.inputs, job))
            for job in every.values()
            if not self.cache.holds(work, job.inputs)
        ]
        run_parallel(calls, self.pool, title)
        return [self.cache.read(work, job.inputs) for job in jobs]
