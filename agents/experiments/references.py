"""Committed envelopes: every class's strongest rules, chosen on tuning seeds, measured on others.

What is tuned and what is tested lies in the work folder under names that hold a hash of all that
it was made from; the tables of a setting in the results folder hold the classes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from fusion_gym.core.system import Knowledge, covers
from fusion_gym.core.task import Task
from fusion_gym.deprecation import replace_value
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import EnvelopePoint, best_mse, lower_hull, points_of
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.importing import refuse_code
from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import saved_agent
from fusion_gym.validation import ConfigurationError

from ..output.files import load_results, read_json, save_results, write
from ..output.folders import check_inputs, fingerprint
from .classes import Class, classes_of
from .config import Family, Setting, Suite, Tuning, front_prices, load_suite
from .tables import Row, group_by, read_rows, write_rows
from .tuning import as_they_are, first_values, policy_text, tune_families
from .workers import Call, Pool, side_by_side

Options = tuple[tuple[str, Any], ...]


class Search(NamedTuple):
    """A family to tune in a setting with some options of its classes.

    With ``policies`` there is nothing to tune: these compete as they are.
    """

    setting: Setting
    options: Options
    family: Family
    tuning: Tuning
    policies: tuple[str, ...] = ()

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its result depends on."""
        result = {
            "environment": self.setting.environment.model_dump(mode="json"),
            "options": dict(self.options),
            "family": self.family.model_dump(mode="json"),
            "price_range": list(self.setting.price_range),
            "tuning": self.tuning.model_dump(mode="json"),
        }
        return result | ({"policies": list(self.policies)} if self.policies else {})

    def path(self, work: Path) -> Path:
        """Its JSON."""
        return work / self.setting.name / "tuned" / f"{fingerprint(self.inputs)}.json"

    def check(self) -> None:
        """Make one of its policies.

        Raises:
            ConfigurationError: the family does not fit; names it, the setting and the options.
        """
        try:
            task = envelope_task(self.setting, self.options)
            texts = self.policies
            if not texts:
                values = first_values(self.family, 1, task.sensors, 0)[0]
                texts = (policy_text(self.family, values, task.sensors),)
            for text in texts:
                make_policy(text, task)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"family = {self.family.label!r} is not allowed in {self.setting.name} with "
                f"{dict(self.options)}: {error}"
            ) from None


@dataclass(frozen=True)
class Test:
    """A chosen policy, to be measured on the test seeds."""

    setting: Setting
    options: Options
    policy: str
    episodes: int
    seed: int

    @property
    def name(self) -> str:
        """The policy, with what the class adds to the setting's options."""
        return policy_with_options(self.policy, self.options)

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its result depends on."""
        return {
            "environment": self.setting.environment.model_dump(mode="json"),
            "options": dict(self.options),
            "policy": self.policy,
            "episodes": self.episodes,
            "seed": self.seed,
        }

    def make(self, task: Task) -> Policy:
        """The policy itself."""
        return make_policy(self.policy, task)

    def path(self, work: Path) -> Path:
        """Its episodes."""
        return work / self.setting.name / "tested" / f"{fingerprint(self.inputs)}.npz"

    def read(self, work: Path) -> EpisodeResults:
        """Its episodes, once it was run.

        Raises:
            ConfigurationError: the file is damaged.
        """
        return load_results(self.path(work), fingerprint(self.inputs))[self.policy]


def policy_with_options(policy: str, options: Iterable[tuple[str, Any]]) -> str:
    """A policy's text, with the options of its class where there are some."""
    added = " ".join(f"{key}={json.dumps(value).strip(chr(34))}" for key, value in options)
    return f"{policy} [{added}]" if added else policy


def envelope_task(setting: Setting, options: Iterable[tuple[str, Any]] = ()) -> Task:
    """The setting's task with the options of a class."""
    return make_task(setting.environment.id, **(setting.environment.options | dict(options)))


def run_search(search: Search, work: Path) -> None:
    """Tune a family and keep its finalists, on the episodes of all searches."""
    task = envelope_task(search.setting, search.options)
    if search.policies:
        tried, finalists = 0, as_they_are(task, search.policies, search.tuning)
    else:
        tried, finalists = tune_families(
            task, search.family, search.tuning, search.setting.price_range
        )
    requests = [
        {
            "policy": finalist.policy,
            "knows": make_policy(finalist.policy, task).knowledge,
            "found_by": list(finalist.found_by),
            "rate": float(finalist.brief.rate.mean()),
            "mse": mean_interval(_finite(finalist.brief.mse))._asdict(),
        }
        for finalist in finalists
    ]
    write(search.path(work), {"inputs": search.inputs, "trials": tried, "policies": requests})


def _finite(mse: Any) -> Any:
    return np.where(np.isfinite(mse), mse, 1e300)


def run_test(test: Test, work: Path) -> None:
    """Measure a policy on the test seeds."""
    task = envelope_task(test.setting, test.options)
    results = run_episodes(task, test.make(task), test.episodes, test.seed)
    save_results(test.path(work), {test.policy: results}, fingerprint(test.inputs))


def searches_of(suite: Suite, setting: Setting, classes: Sequence[Class]) -> list[Search]:
    """What is to be tuned for these classes: their own families, and those of all within them."""
    tuning = suite.tuning_of(setting)
    points = [Family(label=name, policy=name, parameters={}) for name in setting.points]
    within = [c for c in classes_of(setting) if any(item.contains(c) for item in classes)]
    result = []
    for family in [*suite.families_of(setting), *points]:
        if family.tuned_in == "setting":
            worlds = dict.fromkeys(c.world for c in within)
            result += [Search(setting, world, family, tuning) for world in worlds]
        else:
            result += [
                Search(setting, c.options, family, tuning)
                for c in within
                if c.mode == family.tuned_in
            ]
    if setting.known and any(c.world == () for c in within):
        earlier = Family(label="found before", policy="", parameters={})
        result.append(Search(setting, (), earlier, tuning, setting.known))
    return result


class Candidate(NamedTuple):
    """A tuned policy, as a point of rate and error on all tuning episodes."""

    policy: str
    options: Options
    family: str
    knows: Knowledge
    found_by: tuple[int, ...]
    rate: float
    mse: dict[str, float]

    @property
    def point(self) -> EnvelopePoint:
        """Where it lies."""
        return EnvelopePoint(
            policy_with_options(self.policy, self.options), self.rate, self.mse["mean"]
        )


def candidates_of(
    setting: Setting, of: Class, searches: Iterable[Search], work: Path
) -> tuple[dict[str, Candidate], int]:
    """The tuned policies that know no more than a class, by name, and the number of trials."""
    inside = [c for c in classes_of(setting) if of.contains(c)]
    result: dict[str, Candidate] = {}
    trials = 0
    for search in searches:
        able = [c for c in inside if search.family.tuned_in in ("setting", c.mode)]
        if not any(search.options in (c.world, c.options) for c in able):
            continue
        tuned = read_json(search.path(work), "work")
        stored = [
            Candidate(
                policy=entry["policy"],
                options=search.options,
                family=search.family.label,
                knows=replace_value(entry["knows"]),
                found_by=tuple(entry["found_by"]),
                rate=entry["rate"],
                mse=entry["mse"],
            )
            for entry in tuned["policies"]
            if covers(of.knows, replace_value(entry["knows"]))
        ]
        result |= {candidate.point.name: candidate for candidate in stored}
        trials += tuned["trials"] if stored else 0
    return result, trials


def select_candidates(candidates: Mapping[str, Candidate]) -> list[Candidate]:
    """Those on the lower envelope on all tuning episodes, by rising rate."""
    hull = lower_hull(candidate.point for candidate in candidates.values())
    return [candidates[point.name] for point in hull]


def tests_of(suite: Suite, setting: Setting, vertices: Iterable[Candidate]) -> list[Test]:
    """What is to be measured on the test seeds."""
    return [
        Test(setting, vertex.options, vertex.policy, suite.episodes, suite.seed)
        for vertex in vertices
    ]


def content_of(
    suite: Suite, setting: Setting, of: Class, searches: Sequence[Search], work: Path
) -> dict[str, Any]:
    """A class as its JSON holds it, without the hash."""
    candidates, trials = candidates_of(setting, of, searches, work)
    vertices = select_candidates(candidates)
    measured = {test.name: test.read(work) for test in tests_of(suite, setting, vertices)}
    places = {point.name: point for point in points_of(measured)}
    convex = {point.name for point in lower_hull(places.values())}
    listed = [
        {
            "name": vertex.point.name,
            "policy": vertex.policy,
            "options": dict(vertex.options),
            "family": vertex.family,
            "knows": vertex.knows,
            "tuning": {"rate": vertex.rate, "mse": vertex.mse},
            "test": {
                "rate": places[vertex.point.name].rate,
                "mse": mean_interval(measured[vertex.point.name].mse)._asdict(),
            },
            "convex": vertex.point.name in convex,
        }
        for vertex in vertices
    ]
    seeds = suite.tuning_of(setting).seeds
    return {
        "mode": of.mode,
        "memory": of.memory,
        "broadcast": of.broadcast,
        "knows": of.knows,
        "options": dict(of.options),
        "contains": [c.name for c in classes_of(setting) if of.contains(c) and c != of],
        "families": sorted({candidate.family for candidate in candidates.values()}),
        "trials": trials,
        "vertices": listed,
        "searches": [
            [[p.rate, p.mse] for p in lower_hull(c.point for c in best_of_seed(candidates, seed))]
            for seed in range(seeds)
        ],
    }


def best_of_seed(candidates: Mapping[str, Candidate], seed: int) -> list[Candidate]:
    """What one search alone has found."""
    return [candidate for candidate in candidates.values() if seed in candidate.found_by]


def envelope_inputs(suite: Suite, setting: Setting) -> dict[str, Any]:
    """All that a setting's envelopes depend on."""
    return {
        "environment": setting.environment.model_dump(mode="json"),
        "price_range": list(setting.price_range),
        "broadcasts": list(setting.broadcasts),
        "tuning": suite.tuning_of(setting).model_dump(mode="json"),
        "families": {f.label: f.model_dump(mode="json") for f in suite.families_of(setting)},
        "points": list(setting.points),
        "known": list(setting.known),
        "episodes": suite.episodes,
        "seed": suite.seed,
    }


def digest(made_from: Mapping[str, Any], name: str, content: Mapping[str, Any]) -> str:
    """SHA-256 of a class: of its inputs, its name and all that it holds, as canonical JSON."""
    plain = {key: value for key, value in content.items() if key != "sha256"}
    text = json.dumps(
        {"inputs": made_from, "class": name, "content": plain},
        sort_keys=True,
        separators=(",", ":"),
        default=list,
    )
    return hashlib.sha256(text.encode()).hexdigest()


def curves_of(searches: Iterable[Search], work: Path) -> Iterator[dict[str, Any]]:
    """Every family's own lower envelope on the tuning episodes."""
    for search in searches:
        tuned = read_json(search.path(work), "work")
        points = [
            EnvelopePoint(e["policy"], e["rate"], e["mse"]["mean"]) for e in tuned["policies"]
        ]
        yield {
            "family": search.family.label,
            "options": dict(search.options),
            "trials": tuned["trials"],
            "points": [point._asdict() for point in lower_hull(points)],
        }


ENVELOPES = "envelopes"  # of the table for readers, in that of the results
_TABLES = ("setting", "vertices", "searches", "curves", "classes")  # written in this order
_POINT = ("name", "rate", "mse")


def path_of(results: Path, setting: str) -> Path:
    """Where the index of a setting's envelopes is, which is written last."""
    return results / setting / f"{_TABLES[-1]}.csv"


def read_envelopes(folder: Path) -> dict[str, Any]:
    """Return the envelopes in a setting's folder.

    Raises:
        ConfigurationError: a table cannot be read, is of another shape, or a class is not what
            its hash says.
    """
    result: dict[str, Any] = dict(*read_rows(folder, "setting", "envelopes")[:1])
    vertices, searches = (
        group_by(read_rows(folder, table, "envelopes"), "class") for table in _TABLES[1:3]
    )
    result |= {"setting": folder.name, "classes": {}, "curves": []}
    for row in read_rows(folder, "classes", "envelopes"):
        name, sha256 = row.pop("class"), row.pop("sha256")
        by_seed = group_by(searches.get(name, []), "seed")
        content = {"broadcast": None} | row | {
            "vertices": [_nested(vertex) for vertex in vertices.get(name, [])],
            "searches": [[[p["rate"], p["mse"]] for p in points] for points in by_seed.values()],
        }  # fmt: skip
        if digest(result.get("inputs", {}), name, content) != sha256:
            path = str(path_of(folder.parent, folder.name))
            raise ConfigurationError(
                f"envelopes = {path!r}: sha256 = {sha256[:12]!r}… of the class {name!r} is not "
                "that of what the tables hold: they were changed after they were written"
            )
        result["classes"][name] = content | {"sha256": sha256}
    curves: dict[tuple[str, str], dict[str, Any]] = {}
    for row in read_rows(folder, "curves", "envelopes"):
        curve = {key: row[key] for key in ("family", "options", "trials")} | {"points": []}
        curve = curves.setdefault((row["family"], str(row["options"])), curve)
        curve["points"].append({key: row[key] for key in _POINT})
    return result | {"curves": list(curves.values())}


def _nested(row: dict[str, Any]) -> dict[str, Any]:
    """Return a vertex as its hash is made of."""
    for kind in ("tuning", "test"):
        row[kind] = {"rate": row.pop(f"{kind}_rate"), "mse": row.pop(f"{kind}_mse")}
    return row


def write_envelopes(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the tables of a setting's envelopes, the index of classes at the end.

    Whoever reads after a kill finds the classes that were there before: their rows stay the same.
    """
    classes = content["classes"]
    tables: dict[str, list[dict[str, Any]]] = {
        "setting": [dict(content)],
        "vertices": [
            {**vertex, "class": name}
            | {f"{kind}_{key}": vertex[kind][key] for kind in ("tuning", "test")
               for key in ("rate", "mse")}
            for name, of in classes.items() for vertex in of["vertices"]
        ],
        "searches": [
            {"class": name, "seed": seed, "rate": rate, "mse": mse}
            for name, of in classes.items()
            for seed, points in enumerate(of["searches"]) for rate, mse in points
        ],
        "curves": [curve | point for curve in content["curves"] for point in curve["points"]],
        "classes": [{**of, "class": name} for name, of in classes.items()],
    }  # fmt: skip
    for table in _TABLES:
        write_rows(folder, table, tables[table])


def hull_of(content: Mapping[str, Any]) -> list[EnvelopePoint]:
    """Return a committed class's envelope on the test seeds."""
    points = [
        EnvelopePoint(v["name"], v["test"]["rate"], v["test"]["mse"]["mean"])
        for v in content["vertices"]
    ]
    return sorted(points, key=lambda point: (point.rate, point.mse))


def rollout_of(folder: Path) -> tuple[list[EnvelopePoint], int]:
    """Return the rollout in a setting's folder, if it was run, and its number of episodes.

    Raises:
        ConfigurationError: the table is of another shape.
    """
    rows = read_rows(folder, "rollout") if (folder / "rollout.csv").exists() else []
    points = [EnvelopePoint(f"{row['rate']}", row["rate"], row["mse"]["mean"]) for row in rows]
    episodes = rows[0]["episodes"] if rows else 0
    return sorted(points, key=lambda point: point.rate), episodes


def bound_of(folder: Path) -> Row | None:
    """Return the lower bound in a setting's folder, if it was computed.

    Raises:
        ConfigurationError: the table is of another shape.
    """
    rows = read_rows(folder, "bounds") if (folder / "bounds.csv").exists() else []
    return rows[0] | {"costs": rows} if rows else None


def at_least(bound: Row, rate: float) -> float:
    """Return the least error at a rate that the prices' lines leave, between two rates as well."""
    packets = bound["sensors"] * rate
    lines = [cost["lower"] - cost["price"] * packets for cost in bound["costs"]]
    return float(max([bound["floor"], *lines]))


def committed_classes(suite: Suite, setting: Setting, results: Path) -> dict[str, Any]:
    """The classes of a setting that are there, by name, made from these inputs.

    Raises:
        ConfigurationError: as :func:`read_envelopes`, or they were made from other inputs.
    """
    path = path_of(results, setting.name)
    if not path.exists():
        return {}
    content = read_envelopes(path.parent)
    check_inputs(envelope_inputs(suite, setting), content["inputs"], repr(str(path)))
    refuse_code([entry["vertices"] for entry in content["classes"].values()], str(path))
    return content["classes"]


class EnvelopeStore(NamedTuple):
    """Where the envelopes are that agents are compared with, and the suite that made them."""

    suite: Suite
    results: Path

    def classes(self, setting: Setting) -> dict[str, Any]:
        """Return the classes of a setting by name, as :func:`committed_classes`."""
        return committed_classes(self.suite, setting, self.results)

    def envelope(self, setting: Setting, name: str) -> dict[str, Any]:
        """Return a class of a setting.

        Raises:
            ConfigurationError: there is none of that name.
        """
        classes = self.classes(setting)
        if name not in classes:
            path = str(path_of(self.results, setting.name))
            raise ConfigurationError(
                f"envelopes = {path!r} is not allowed: it has no class {name!r}: tune it first"
            )
        return classes[name]

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
    there = committed_classes(suite, setting, results)
    every = [c for c in classes_of(setting) if not names or c.name in names]
    missing = [c for c in every if c.name not in there]
    for search in searches_of(suite, setting, missing):
        search.check()
    return missing


def complete_envelopes(
    suite: Suite, settings: Sequence[Setting], names: Sequence[str], results: Path, work: Path,
    pool: Pool,
) -> None:  # fmt: skip
    """Tune, choose and measure what is missing of these classes (none: all), setting by setting.

    Raises:
        ConfigurationError: as :func:`missing_classes`, before anything runs.
    """
    missing = [(item, missing_classes(suite, item, names, results)) for item in settings]
    for setting, required in missing:
        if required:
            _complete(suite, setting, required, results, work, pool)


def _complete(
    suite: Suite, setting: Setting, required: Sequence[Class], results: Path, work: Path, pool: Pool
) -> None:
    searches = searches_of(suite, setting, required)
    left = [search for search in searches if not search.path(work).exists()]
    left.sort(key=lambda search: -len(search.family.parameters))  # the long ones first
    side_by_side(
        [Call(10.0, run_search, (item, work)) for item in left], pool, f"{setting.name}: tuning"
    )
    vertices = [
        vertex
        for of in required
        for vertex in select_candidates(candidates_of(setting, of, searches, work)[0])
    ]
    tests = {item.path(work): item for item in tests_of(suite, setting, vertices)}
    side_by_side(
        [Call(2.0, run_test, (test, work)) for path, test in tests.items() if not path.exists()],
        pool,
        f"{setting.name}: testing",
    )
    classes = committed_classes(suite, setting, results)
    inputs = envelope_inputs(suite, setting)
    for of in required:
        content = content_of(suite, setting, of, searches, work)
        classes[of.name] = content | {"sha256": digest(inputs, of.name, content)}
    task, path = envelope_task(setting), path_of(results, setting.name)
    earlier = read_envelopes(path.parent)["curves"] if path.exists() else []
    curves = merge_curves(earlier, list(curves_of(searches, work)))
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
    write_envelopes(path.parent, report)


def merge_curves(
    earlier: Sequence[dict[str, Any]], new: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Each family's curve in each world, once: classes that are added take none away."""
    every = {(item["family"], str(item["options"])): item for item in (*earlier, *new)}
    return list(every.values())


# Beside the folder of the commands, in a clone as in an installed package.
SHIPPED = Path(__file__).parents[2] / "results"
PRICES = 7


@dataclass(frozen=True)
class AgentTest(Test):
    """An agent asked at a price; ``digest`` is the SHA-256 of its model's file."""

    model: Path
    digest: str
    price: float

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its result depends on: not where the model lies."""
        return super().inputs | {"model": self.digest}

    def make(self, task: Task) -> Policy:
        """The agent at its price."""
        return saved_agent(task, str(self.model), price=self.price)


@dataclass(frozen=True)
class CommittedRules:
    """A setting with its committed envelopes, the bound and the rollout; and the test episodes.

    ``rollout`` are points on the first ``simulated`` of them.
    """

    setting: Setting
    envelopes: Mapping[str, Any]
    bound: dict[str, Any] | None
    rollout: Sequence[EnvelopePoint]
    simulated: int
    episodes: int
    seed: int

    @classmethod
    def read(cls, name: str, episodes: int) -> CommittedRules:
        """That of one of the benchmark's settings, from the results that are shipped.

        Raises:
            ConfigurationError: a file that is absent, damaged or made from other settings.
        """
        suite = load_suite("benchmark")
        setting = next(setting for setting in suite.settings if setting.name == name)
        path = path_of(SHIPPED, name)
        envelopes = read_envelopes(path.parent)
        check_inputs(envelope_inputs(suite, setting), envelopes["inputs"], repr(str(path)))
        rollout, simulated = rollout_of(path.parent)
        bound = bound_of(path.parent)
        return cls(setting, envelopes, bound, rollout, simulated, episodes, suite.seed)

    def rules(self, name: str) -> dict[str, Test]:
        """The rules of a class, by name."""
        return {
            vertex["name"]: Test(
                self.setting,
                tuple(vertex["options"].items()),
                vertex["policy"],
                self.episodes,
                self.seed,
            )
            for vertex in self.envelopes["classes"][name]["vertices"]
        }

    def agents(self, name: str, model: Path) -> list[AgentTest]:
        """An agent that belongs to a class, at prices over the whole range."""
        digest = hashlib.sha256(model.read_bytes()).hexdigest()
        options = tuple(self.envelopes["classes"][name]["options"].items())
        return [
            AgentTest(
                self.setting, options, f"agent at price {price:.4g}", self.episodes, self.seed,
                model, digest, price,
            )
            for price in front_prices(self.setting.price_range, PRICES)
        ]  # fmt: skip

    def single(self, name: str) -> list[tuple[float, float]]:
        """Rate and error of every tuned rule of a class, each as far from its envelope as on tuning
        episodes, which are easier or harder than those of the test."""
        content = self.envelopes["classes"][name]
        vertices = sorted(content["vertices"], key=lambda vertex: vertex["tuning"]["rate"])
        rates = [vertex["tuning"]["rate"] for vertex in vertices]
        harder = [v["test"]["mse"]["mean"] / v["tuning"]["mse"]["mean"] for v in vertices]
        return [
            (point["rate"], float(point["mse"] * np.interp(point["rate"], rates, harder)))
            for curve in self.envelopes["curves"]
            if curve["family"] in content["families"]
            and curve["options"] in ({}, content["options"])
            for point in curve["points"]
        ]

    def simulations(self, rules: Mapping[str, EpisodeResults]) -> list[tuple[float, float]]:
        """Rate and error of the rollout, its error as a share of these rules' on its episodes.

        Its few episodes are easier or harder than all of them by more than what it brings.
        """
        result = []
        for point in self.rollout if self.simulated <= self.episodes else ():
            below = best_mse(rules, point.rate)
            if below is not None:
                result.append(
                    (point.rate, point.mse / below[: self.simulated].mean() * below.mean())
                )
        return result


def measure(test: Test, work: Path) -> None:
    """Run a test, in a worker."""
    torch.set_num_threads(1)
    run_test(test, work)


class Trials(NamedTuple):
    """What is run on the test episodes: an agent at its prices, and the rules of its classes."""

    ground: CommittedRules
    agent: Sequence[AgentTest]
    rules: Mapping[str, Mapping[str, Test]]
    work: Path

    @classmethod
    def of(cls, ground: CommittedRules, classes: Sequence[str], folder: Path) -> Trials:
        """Those of an agent that was trained in the folder and is of the last of these classes."""
        return cls(
            ground,
            ground.agents(classes[-1], folder / "agent" / "best_model.zip"),
            {name: ground.rules(name) for name in classes},
            folder / "episodes",
        )

    def left(self) -> list[Call]:
        """What was not run before."""
        rules = [test for of in self.rules.values() for test in of.values()]
        every = {test.path(self.work): test for test in (*self.agent, *rules)}
        weight = 0.4 + 0.9 * self.ground.episodes / 1000
        return [
            Call(weight, measure, (test, self.work))
            for path, test in every.items()
            if not path.exists()
        ]

    def results(self, name: str) -> dict[str, EpisodeResults]:
        """The rules of a class, once they were run."""
        return {rule: test.read(self.work) for rule, test in self.rules[name].items()}

    def report(self) -> dict[str, Any]:
        """The agent at its prices beside the rules of each class at its own rates.

        A point has ``price``, ``rate``, ``mse`` and of each class the rules' ``mse`` and the paired
        ``difference`` to it, as a share of it, with its 95 % interval over episodes; nothing of a
        class whose rules all transmit more. ``mean`` is that of the differences at all prices.
        """
        learned = [test.read(self.work) for test in self.agent]
        points: list[dict[str, Any]] = [
            {
                "price": test.price,
                "rate": float(value.rate.mean()),
                "mse": mean_interval(value.mse)._asdict(),
                "rules": {},
            }
            for test, value in zip(self.agent, learned, strict=True)
        ]
        means = {}
        for name in self.rules:
            results, shares = self.results(name), []
            for point, value in zip(points, learned, strict=True):
                below = best_mse(results, point["rate"])
                if below is not None:
                    shares.append((value.mse - below) / below.mean())
                    point["rules"][name] = {
                        "mse": float(below.mean()),
                        "difference": mean_interval(shares[-1])._asdict(),
                    }
            if len(shares) == len(points):
                means[name] = mean_interval(np.mean(shares, axis=0))._asdict()
        ground = self.ground
        return {
            "setting": ground.setting.name,
            "env": ground.setting.environment.id,
            "options": ground.setting.environment.options,
            "episodes": ground.episodes,
            "seed": ground.seed,
            "model": self.agent[0].digest,
            "classes": {name: ground.envelopes["classes"][name]["sha256"] for name in self.rules},
            "points": points,
            "mean": means,
        }
