"""The file of a setting's envelopes: made piece by piece, read with its hashes checked."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pydantic
from pydantic import FiniteFloat

from fusion_gym.importing import refuse_code
from fusion_gym.validation import ConfigurationError

from ..output.files import write
from ..output.folders import check_inputs
from . import envelopes
from .classes import Class, classes_of
from .config import Setting, Suite
from .reports import IntervalRecord, Known, Shape, read_shape
from .team import Team
from .workers import Work, side_by_side

FOLDER = "envelopes"  # in that of the results


class PlaceRecord(Shape):
    """A policy's mean rate and its error."""

    rate: FiniteFloat
    mse: IntervalRecord


class Vertex(Shape):
    """A policy of an envelope, on the tuning and on the test episodes."""

    name: str
    policy: str
    options: dict[str, Any]
    family: str
    knows: Known
    tuning: PlaceRecord
    test: PlaceRecord
    convex: bool


class EnvelopeRecord(Shape):
    """One class."""

    mode: str
    memory: bool
    broadcast: str | None
    knows: Known
    options: dict[str, Any]
    contains: list[str]
    families: list[str]
    trials: int
    vertices: list[Vertex] = pydantic.Field(min_length=1)
    searches: list[list[list[FiniteFloat]]] = pydantic.Field(min_length=1)
    sha256: str = pydantic.Field(pattern=r"^[0-9a-f]{64}$")


class EnvelopesRecord(Shape):
    """A setting's ``envelopes/SETTING.json``."""

    setting: str
    title: str
    env: str
    always: FiniteFloat
    inputs: dict[str, Any]
    classes: dict[str, EnvelopeRecord]
    curves: list[dict[str, Any]]


def path_of(results: Path, setting: str) -> Path:
    """Where a setting's envelopes are."""
    return results / FOLDER / f"{setting}.json"


def read_envelopes(path: Path) -> dict[str, Any]:
    """A setting's envelopes.

    Raises:
        ConfigurationError: the file cannot be read, is of another shape, or a class is not what
            its hash says.
    """
    result = read_shape(EnvelopesRecord, path, "envelopes")
    for name, content in result["classes"].items():
        if envelopes.digest(result["inputs"], name, content) != content["sha256"]:
            raise ConfigurationError(
                f"envelopes = {str(path)!r}: classes.{name}.sha256 = {content['sha256'][:12]!r}… "
                "is not that of what it holds: it was changed after it was written"
            )
    return result


def present(suite: Suite, setting: Setting, results: Path) -> dict[str, Any]:
    """The classes of a setting that are there, by name, made from these inputs.

    Raises:
        ConfigurationError: as :func:`read_envelopes`, or they were made from other inputs.
    """
    path = path_of(results, setting.name)
    if not path.exists():
        return {}
    content = read_envelopes(path)
    check_inputs(envelopes.envelope_inputs(suite, setting), content["inputs"], repr(str(path)))
    return content["classes"]


class Shelf(NamedTuple):
    """Where the envelopes are that agents are compared with, and the suite that made them."""

    suite: Suite
    results: Path

    def classes(self, setting: Setting) -> dict[str, Any]:
        """What is there of a setting, as :func:`present`."""
        return present(self.suite, setting, self.results)

    def envelopes(self, setting: Setting) -> dict[str, Any]:
        """What is there of a setting; nothing, if that was made from another suite."""
        try:
            return self.classes(setting)
        except ConfigurationError:
            return {}

    def vertices(self, setting: Setting, names: Sequence[str]) -> list[dict[str, Any]]:
        """The rules of some classes, each once."""
        classes = self.classes(setting)
        result = {v["name"]: v for name in names for v in classes[name]["vertices"]}
        return list(result.values())


def missing_classes(
    suite: Suite, setting: Setting, names: Sequence[str], results: Path
) -> list[Class]:
    """Return the missing ones of these classes (none: all), whose rules are all made once.

    Raises:
        ConfigurationError: a family that does not fit, envelopes made from other inputs, or ones
            that name code.
    """
    there = present(suite, setting, results)
    rules = [content["vertices"] for content in there.values()]
    refuse_code(rules, str(path_of(results, setting.name)))
    every = [c for c in classes_of(setting) if not names or c.name in names]
    missing = [c for c in every if c.name not in there]
    for search in envelopes.searches_of(suite, setting, missing):
        search.check()
    return missing


def complete(
    suite: Suite, settings: Sequence[Setting], names: Sequence[str], results: Path, work: Path,
    team: Team,
) -> None:  # fmt: skip
    """Tune, choose and measure what is missing of these classes (none: all), setting by setting.

    Raises:
        ConfigurationError: as :func:`missing_classes`, before anything runs.
    """
    missing = [(item, missing_classes(suite, item, names, results)) for item in settings]
    for setting, required in missing:
        if required:
            _complete(suite, setting, required, results, work, team)


def _complete(
    suite: Suite, setting: Setting, required: Sequence[Class], results: Path, work: Path, team: Team
) -> None:
    searches = envelopes.searches_of(suite, setting, required)
    left = [search for search in searches if not search.path(work).exists()]
    left.sort(key=lambda search: -len(search.family.parameters))  # the long ones first
    side_by_side(
        [Work(10.0, envelopes.run_search, (item, work)) for item in left],
        team,
        f"{setting.name}: tuning",
    )
    vertices = [
        vertex
        for of in required
        for vertex in envelopes.select_candidates(
            envelopes.candidates_of(setting, of, searches, work)[0]
        )
    ]
    tests = {item.path(work): item for item in envelopes.tests_of(suite, setting, vertices)}
    side_by_side(
        [
            Work(2.0, envelopes.run_test, (test, work))
            for path, test in tests.items()
            if not path.exists()
        ],
        team,
        f"{setting.name}: testing",
    )
    classes = present(suite, setting, results)
    inputs = envelopes.envelope_inputs(suite, setting)
    for of in required:
        content = envelopes.content_of(suite, setting, of, searches, work)
        classes[of.name] = content | {"sha256": envelopes.digest(inputs, of.name, content)}
    task, path = envelopes.envelope_task(setting), path_of(results, setting.name)
    earlier = read_envelopes(path)["curves"] if path.exists() else []
    curves = merged_curves(earlier, list(envelopes.curves_of(searches, work)))
    always = next(curve for curve in curves if curve["family"] == "always")
    order = [c.name for c in classes_of(setting)]
    report = {
        "setting": setting.name,
        "title": setting.title,
        "env": setting.environment.id,
        "options": setting.environment.options,
        "horizon": task.horizon,
        "always": always["points"][0]["rate"],
        "inputs": inputs,
        "classes": {name: classes[name] for name in order if name in classes},
        "curves": curves,
    }
    write(path, report)


def merged_curves(
    earlier: Sequence[dict[str, Any]], new: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Each family's curve in each world, once: classes that are added take none away."""
    every = {(item["family"], str(item["options"])): item for item in (*earlier, *new)}
    return list(every.values())
