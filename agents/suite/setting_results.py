"""What the results folder holds of a setting, read and checked before anything is made of it."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fusion_gym.evaluation.envelope import EnvelopePoint, height
from fusion_gym.validation import ConfigurationError

from .committed import path_of, read_envelopes
from .envelope_table import bound_of, hull_of, measured
from .reports import VERDICT, Agent, Baselines, TestRecord, Verdict, read_shape

Points = list[tuple[float, float]]  # rate and error


class SettingResults(NamedTuple):
    """A setting's results.

    ``seeds[class]`` has a training seed's points, by price; ``ahead`` are the scheduler's
    references and ``known`` those of the centre; ``validation`` says on which episodes the agents
    were validated, and ``envelopes`` is the file of committed envelopes. What is not there is
    empty.
    """

    name: str
    verdict: dict[str, Any]
    baselines: dict[str, Any]
    ahead: list[EnvelopePoint]
    known: list[EnvelopePoint]
    seeds: Mapping[str, Sequence[Points]]
    validation: dict[str, Any]
    envelopes: dict[str, Any]
    rollout: list[EnvelopePoint]
    rollout_episodes: int
    bound: dict[str, Any] | None

    @property
    def label(self) -> str:
        """The setting's name for readers: its title up to the first comma."""
        return str(self.verdict["title"].split(",")[0])

    @property
    def classes(self) -> dict[str, Any]:
        """The classes that have agents."""
        return self.verdict["classes"]

    @property
    def optimal(self) -> bool:
        """Whether the scheduler's reference is the optimum."""
        names = [point.name for point in self.ahead]
        return bool(names) and all(name.startswith("optimal:") for name in names)

    def hull(self, name: str) -> list[EnvelopePoint]:
        """The envelope of a class on the test seeds; empty without one."""
        if name in self.classes:
            places = self.classes[name]["envelope"]
            return [EnvelopePoint(p["name"], p["rate"], p["mse"]) for p in places]
        committed = self.envelopes.get("classes", {})
        return hull_of(committed[name]) if name in committed else []

    def rules_at(self, name: str, rate: float) -> float | None:
        """The error of a class's rules at a rate."""
        hull = self.hull(name)
        return height(hull, rate) if hull else None


def read_results(results: Path) -> dict[str, SettingResults]:
    """Every setting that is judged, by name.

    Raises:
        ConfigurationError: there are none, or a file that is no such JSON.
    """
    result = {
        path.parent.name: read_setting(path.parent) for path in sorted(results.glob(f"*/{VERDICT}"))
    }
    if not result:
        raise ConfigurationError(
            f"results = {str(results)!r} is not allowed: it must hold results of the benchmark"
        )
    return result


def read_setting(folder: Path) -> SettingResults:
    """One setting's results.

    Raises:
        ConfigurationError: a file that cannot be read or is of another shape, or files that do not
            fit together.
    """
    name, results = folder.name, folder.parent
    verdict = read_shape(Verdict, folder / VERDICT, "results")
    baselines = read_shape(Baselines, folder / "baselines.json", "results")
    named = [policy for curve in baselines["curves"].values() for policy in curve["policies"]]
    named += [place["name"] for of in verdict["classes"].values() for place in of["envelope"]]
    for item in named:
        if item not in baselines["policies"]:
            raise ConfigurationError(
                f"results = {str(folder)!r} do not fit together: baselines.json has no policy "
                f"{item!r}, of which it or {VERDICT} speaks"
            )
    classes, committed = verdict["classes"], path_of(results, name)
    agents = _agents(folder, classes)
    rollout, episodes = measured(results / "rollout" / f"{name}.json", name)
    return SettingResults(
        name,
        verdict,
        baselines,
        _places(folder / "informed.json"),
        _places(folder / "references.json"),
        {name: _columns(own, len(classes[name]["points"])) for name, own in agents.items()},
        next((a["training"]["validation"] for own in agents.values() for a in own), {}),
        read_envelopes(committed) if committed.exists() else {},
        rollout,
        episodes,
        bound_of(results / "bounds" / f"{name}.json"),
    )


def _places(path: Path) -> list[EnvelopePoint]:
    """The policies of a file, if it is there, by rising rate."""
    policies = read_shape(TestRecord, path, "results")["policies"] if path.exists() else {}
    result = [EnvelopePoint(name, rate_of(p), p["mse"]["mean"]) for name, p in policies.items()]
    return sorted(result, key=lambda point: (point.rate, point.mse))


def _agents(folder: Path, classes: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """The agents of the classes that are judged, by training seed."""
    result: dict[str, list[dict[str, Any]]] = {}
    for path in sorted(folder.glob("agent_*.json")):
        # The class is in the file's name; what else lies there is none of these agents.
        named = re.fullmatch(r"agent_(\w+)_\d+", path.stem)
        if named and named[1] in classes:
            result.setdefault(named[1], []).append(read_shape(Agent, path, "results"))
    return result


def _columns(agents: Sequence[Mapping[str, Any]], prices: int) -> list[Points]:
    """Each training seed's points, of those at as many prices."""
    return [
        [(rate_of(point), point["mse"]["mean"]) for point in agent["points"]]
        for agent in agents
        if len(agent["points"]) == prices
    ]


def rate_of(policy: Mapping[str, Any]) -> float:
    """A tested policy's mean rate per sensor and step."""
    return float(sum(policy["rate"]) / len(policy["rate"]))
