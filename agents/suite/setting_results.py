"""What the results folder holds of a setting, read and checked before anything is made of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fusion_gym.evaluation.envelope import EnvelopePoint, height
from fusion_gym.validation import ConfigurationError

from .committed import path_of, read_envelopes
from .envelope_table import bound_of, hull_of, measured
from .tables import VERDICT, grouped, read_rows

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
        ConfigurationError: there are none, or a table that cannot be read.
    """
    result = {
        path.parent.name: read_setting(path.parent)
        for path in sorted(results.glob(f"*/{VERDICT}.csv"))
    }
    if not result:
        earlier = ", and not JSON of an earlier version" * any(results.glob(f"*/{VERDICT}.json"))
        raise ConfigurationError(
            f"results = {str(results)!r} is not allowed: it must hold tables of the "
            f"benchmark{earlier}"
        )
    return result


def read_setting(folder: Path) -> SettingResults:
    """One setting's results.

    Raises:
        ConfigurationError: a table that cannot be read or is of another shape.
    """
    name, results = folder.name, folder.parent
    verdict = read_verdict(folder)
    policies = grouped(read_rows(folder, "policies"), "run")
    baselines = {key: verdict[key] for key in ("env", "episodes", "seed")}
    for row in policies.get("genie", []):
        baselines["genie"] = row | {"assumes": row["name"]}
    seeds: dict[str, list[Points]] = {}
    validation: dict[str, Any] = {}
    for run in read_rows(folder, "runs"):
        if run.get("class") in verdict["classes"]:
            validation = validation or run["inputs"]["training"]["validation"]
            points = [(rate_of(p), p["mse"]["mean"]) for p in policies.get(run["run"], [])]
            if len(points) == len(verdict["classes"][run["class"]]["points"]):
                seeds.setdefault(run["class"], []).append(points)
    rollout, episodes = measured(folder)
    committed = path_of(results, name)
    return SettingResults(
        name,
        verdict,
        baselines,
        _places(policies.get("informed", [])),
        _places(policies.get("references", [])),
        seeds,
        validation,
        read_envelopes(folder) if committed.exists() else {},
        rollout,
        episodes,
        bound_of(folder),
    )


def read_verdict(folder: Path) -> dict[str, Any]:
    """Return the verdict of a setting, with its classes by name.

    Raises:
        ConfigurationError: a table that cannot be read or is of another shape.
    """
    rows = read_rows(folder, VERDICT)
    if len(rows) != 1 or rows[0]["always"] <= 0.0:
        path = str(folder / f"{VERDICT}.csv")
        raise ConfigurationError(
            f"results = {path!r}: always = {[row['always'] for row in rows]} is not allowed: it "
            "must be one positive rate"
        )
    parts = {
        part: grouped(read_rows(folder, table), "class")
        for part, table in (("points", "points"), ("at", "equal_rates"), ("envelope", "tested"))
    }
    classes: dict[str, Any] = {}
    for row in read_rows(folder, "fronts"):
        name = row.pop("class")
        classes[name] = {"broadcast": None} | row
        classes[name] |= {part: every.get(name, []) for part, every in parts.items()}
    return rows[0] | {"classes": classes, "worth": read_rows(folder, "worth")}


def _places(policies: Sequence[Mapping[str, Any]]) -> list[EnvelopePoint]:
    """The policies by rising rate."""
    result = [EnvelopePoint(p["name"], rate_of(p), p["mse"]["mean"]) for p in policies]
    return sorted(result, key=lambda point: (point.rate, point.mse))


def rate_of(policy: Mapping[str, Any]) -> float:
    """A tested policy's mean rate per sensor and step."""
    return float(sum(policy["rate"]) / len(policy["rate"]))
