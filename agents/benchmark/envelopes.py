"""Committed envelopes: every class's strongest rules, chosen on tuning seeds, measured on others.

A finished piece, a :class:`Search` or a :class:`Test`, stays in the work folder's cache; the tables
of a setting in the results folder hold the classes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from agents.benchmark.classes import Class, classes_of
from agents.benchmark.config import Family, Setting, Suite, Tuning, front_prices
from agents.benchmark.tables import Row, group_by, read_rows, write_rows
from agents.benchmark.tuning import WORST, first_values, policy_text, tune_families
from agents.cache import Cache
from agents.workers import Pool, missing, side_by_side
from fusion_gym import zoo
from fusion_gym.core.system import covers
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import EnvelopePoint, lower_hull, points_of
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.importing import refuse_code
from fusion_gym.output.folders import check_inputs
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

# Beside the folder of the commands, in a clone as in an installed package.
SHIPPED = Path(__file__).parents[2] / "results"
Options = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Search:
    """A family to tune in a setting with some options of its classes.

    With ``policies`` there is nothing to tune: these compete as they are.
    """

    setting: Setting
    options: Options
    family: Family
    tuning: Tuning
    policies: tuple[str, ...] = ()
    weight: ClassVar[float] = 10.0

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
    """A policy to be measured on the test episodes, with options that it adds to the setting's.

    ``label`` stands for its text where that names a file.
    """

    setting: Setting
    options: Options
    policy: str
    episodes: int
    seed: int
    label: str | None = None
    weight: ClassVar[float] = 1.0

    @property
    def name(self) -> str:
        """The policy, with what the class adds to the setting's options."""
        return policy_with_options(self.label or self.policy, self.options)

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its result depends on."""
        own = {"options": dict(self.options), "policy": self.label or self.policy}
        return tested_inputs(self.setting, self.episodes, self.seed) | own

    def task(self) -> Task:
        """Return the task in which it runs."""
        return envelope_task(self.setting, self.options)

    @classmethod
    def at_prices(
        cls, setting: Setting, options: Options, agent: str, count: int, episodes: int, seed: int
    ) -> list[Test]:
        """Return the tests of an agent, "model:PATH" or "zoo:NAME", at prices over the range.

        Raises:
            OSError: the agent's file cannot be read.
        """
        kind, _, name = agent.partition(":")
        content = Path(zoo.model_path(name) if kind == "zoo" else name).read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        return [
            cls(
                *(setting, options, f"{agent},price={price!r}", episodes, seed),
                label=f"agent {digest},price={price!r}",
            )
            for price in front_prices(setting.price_range, count)
        ]


def tested_inputs(setting: Setting, episodes: int, seed: int) -> dict[str, Any]:
    """Return what every result on the test episodes of a setting depends on."""
    environment = setting.environment.model_dump(mode="json")
    return {"environment": environment, "episodes": episodes, "seed": seed}


def policy_with_options(policy: str, options: Iterable[tuple[str, Any]]) -> str:
    """A policy's text, with the options of its class where there are some."""
    added = " ".join(f"{key}={json.dumps(value).strip(chr(34))}" for key, value in options)
    return f"{policy} [{added}]" if added else policy


def envelope_task(setting: Setting, options: Iterable[tuple[str, Any]] = ()) -> Task:
    """The setting's task with the options of a class."""
    return make_task(setting.environment.id, **(setting.environment.options | dict(options)))


def run_search(search: Search) -> dict[str, Any]:
    """Return a family's finalists, on the episodes of all searches, and the number of trials."""
    task = envelope_task(search.setting, search.options)
    tried, finalists = tune_families(
        task, search.family, search.tuning, search.setting.price_range, search.policies
    )
    policies = [
        {
            "policy": policy,
            "knows": make_policy(policy, task).knowledge,
            "found_by": found_by,
            "rate": float(brief.rate.mean()),
            "mse": mean_interval(np.nan_to_num(brief.mse, nan=WORST, posinf=WORST))._asdict(),
        }
        for policy, brief, found_by in finalists
    ]
    return {"trials": tried, "policies": policies}


def run_test(test: Test) -> EpisodeResults:
    """Return what a policy does on the test episodes."""
    torch.set_num_threads(1)
    task = test.task()
    return run_episodes(task, make_policy(test.policy, task), test.episodes, test.seed)


def read_tests(tests: Iterable[Test], cache: Cache) -> dict[str, EpisodeResults]:
    """Return the results of tests by name; runs those that were not run."""
    return {test.name: cache.call(run_test, test.inputs, test) for test in tests}


def rule_tests(
    setting: Setting, vertices: Iterable[Mapping[str, Any]], episodes: int, seed: int
) -> list[Test]:
    """Return the tests of committed rules."""
    return [
        Test(setting, tuple(rule["options"].items()), rule["policy"], episodes, seed)
        for rule in vertices
    ]


def searches_of(suite: Suite, setting: Setting, classes: Sequence[Class]) -> list[Search]:
    """What is to be tuned for these classes, and for all classes within them."""
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


def candidates_of(
    setting: Setting, of: Class, searches: Iterable[Search], cache: Cache
) -> tuple[dict[str, Row], int]:
    """Return the tuned policies that know no more than a class, by name, and the trials."""
    inside = [c for c in classes_of(setting) if of.contains(c)]
    result: dict[str, Row] = {}
    trials = 0
    for search in searches:
        able = [c for c in inside if search.family.tuned_in in ("setting", c.mode)]
        if not any(search.options in (c.world, c.options) for c in able):
            continue
        tuned = cache.call(run_search, search.inputs, search)
        own = {"options": dict(search.options), "family": search.family.label}
        fitting = {
            policy_with_options(entry["policy"], search.options): entry | own
            for entry in tuned["policies"]
            if covers(of.knows, entry["knows"])
        }
        result |= fitting
        trials += tuned["trials"] if fitting else 0
    return result, trials


def hull_of_tuned(candidates: Mapping[str, Row]) -> list[EnvelopePoint]:
    """Return the lower envelope on all tuning episodes, by rising rate."""
    return lower_hull(
        EnvelopePoint(name, row["rate"], row["mse"]["mean"]) for name, row in candidates.items()
    )


def content_of(
    suite: Suite, setting: Setting, of: Class, searches: Sequence[Search], cache: Cache
) -> dict[str, Any]:
    """Return a class as its tables hold it, without the hash."""
    candidates, trials = candidates_of(setting, of, searches, cache)
    vertices = {point.name: candidates[point.name] for point in hull_of_tuned(candidates)}
    tests = rule_tests(setting, vertices.values(), suite.episodes, suite.seed)
    measured = read_tests(tests, cache)
    places = {point.name: point for point in points_of(measured)}
    convex = {point.name for point in lower_hull(places.values())}
    listed = [
        {
            "name": name,
            **{key: vertex[key] for key in ("policy", "options", "family", "knows")},
            "tuning_rate": vertex["rate"],
            "tuning_mse": vertex["mse"],
            "test_rate": places[name].rate,
            "test_mse": mean_interval(measured[name].mse)._asdict(),
            "convex": name in convex,
        }
        for name, vertex in vertices.items()
    ]
    by_seed = [
        {name: row for name, row in candidates.items() if seed in row["found_by"]}
        for seed in range(suite.tuning_of(setting).seeds)
    ]
    return {
        **{key: getattr(of, key) for key in ("mode", "memory", "broadcast", "knows")},
        "options": dict(of.options),
        "contains": [c.name for c in classes_of(setting) if of.contains(c) and c != of],
        "families": sorted({candidate["family"] for candidate in candidates.values()}),
        "trials": trials,
        "vertices": listed,
        "searches": [[[p.rate, p.mse] for p in hull_of_tuned(own)] for own in by_seed],
    }


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
    plain["vertices"] = [_nested(vertex) for vertex in content["vertices"]]
    text = json.dumps(
        {"inputs": made_from, "class": name, "content": plain},
        sort_keys=True,
        separators=(",", ":"),
        default=list,
    )
    return hashlib.sha256(text.encode()).hexdigest()


def _nested(vertex: Mapping[str, Any]) -> dict[str, Any]:
    """Return a vertex as its hash is made of."""
    kinds = ("tuning", "test")
    plain = {key: value for key, value in vertex.items() if not key.startswith(kinds)}
    return plain | {
        kind: {key: vertex[f"{kind}_{key}"] for key in ("rate", "mse")} for kind in kinds
    }


def curves_of(searches: Iterable[Search], cache: Cache) -> Iterator[Row]:
    """Yield the points of every family's own lower envelope on the tuning episodes."""
    for search in searches:
        tuned = cache.call(run_search, search.inputs, search)
        own = {"family": search.family.label, "options": dict(search.options)}
        for point in lower_hull(
            EnvelopePoint(e["policy"], e["rate"], e["mse"]["mean"]) for e in tuned["policies"]
        ):
            yield own | {"trials": tuned["trials"]} | point._asdict()


_TABLES = ("setting", "vertices", "searches", "curves", "classes")  # written in this order


def path_of(results: Path, setting: str) -> Path:
    """Where the index of a setting's envelopes is, which is written last."""
    return results / setting / f"{_TABLES[-1]}.csv"


def read_envelopes(folder: Path) -> dict[str, Any]:
    """Return the envelopes in a setting's folder: its row, ``classes`` by name, and ``curves``.

    Raises:
        ConfigurationError: a table cannot be read, is of another shape, or a class is not what
            its hash says.
    """
    tables = {table: read_rows(folder, table, "envelopes") for table in _TABLES}
    result: dict[str, Any] = dict(*tables["setting"][:1])
    result |= {"setting": folder.name, "classes": {}, "curves": tables["curves"]}
    vertices, searches = (group_by(tables[table], "class") for table in _TABLES[1:3])
    for row in tables["classes"]:
        name, sha256 = row.pop("class"), row.pop("sha256")
        by_seed = group_by(searches.get(name, []), "seed")
        content = {"broadcast": None} | row | {
            "vertices": vertices.get(name, []),
            "searches": [[[p["rate"], p["mse"]] for p in points] for points in by_seed.values()],
        }  # fmt: skip
        if digest(result.get("inputs", {}), name, content) != sha256:
            path = str(path_of(folder.parent, folder.name))
            raise ConfigurationError(
                f"envelopes = {path!r}: sha256 = {sha256[:12]!r}… of the class {name!r} is not "
                "that of what the tables hold: they were changed after they were written"
            )
        result["classes"][name] = content | {"sha256": sha256}
    return result


def write_envelopes(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the tables of a setting's envelopes, the index of classes at the end.

    Whoever reads after a kill finds the classes that were there before: their rows stay the same.
    """
    classes = content["classes"]
    tables: dict[str, list[dict[str, Any]]] = {
        "setting": [dict(content)],
        "vertices": [v | {"class": name} for name, of in classes.items() for v in of["vertices"]],
        "searches": [
            {"class": name, "seed": seed, "rate": rate, "mse": mse}
            for name, of in classes.items()
            for seed, points in enumerate(of["searches"]) for rate, mse in points
        ],
        "curves": content["curves"],
        "classes": [of | {"class": name} for name, of in classes.items()],
    }  # fmt: skip
    for table in _TABLES:
        write_rows(folder, table, tables[table])


def hull_of(content: Mapping[str, Any]) -> list[EnvelopePoint]:
    """Return a committed class's envelope on the test seeds."""
    points = [
        EnvelopePoint(v["name"], v["test_rate"], v["test_mse"]["mean"]) for v in content["vertices"]
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


def check_vertex(vertex: Mapping[str, Any], results: EpisodeResults) -> None:
    """Whether a rule does on the test seeds what its envelope says."""
    claim, does = vertex["test_mse"]["mean"], float(results.mse.mean())
    if not np.isclose(claim, does, rtol=1e-6):
        raise ConfigurationError(
            f"envelopes: {vertex['name']!r} has an error of {does:.6g} on the test seeds, and not "
            f"{claim:.6g} as its envelope says: tune it again"
        )


class EnvelopeStore(NamedTuple):
    """Where the committed envelopes are, and the suite that made them."""

    suite: Suite
    results: Path

    def read(self, setting: Setting) -> dict[str, Any]:
        """Return a setting's envelopes, made from these inputs; no classes if none are there.

        Rules that were tuned in an earlier version of the environment are rules of this one too.

        Raises:
            ConfigurationError: as :func:`read_envelopes`, they were made from other inputs, or
                they name code.
        """
        path = path_of(self.results, setting.name)
        if not path.exists():
            return {"classes": {}, "curves": []}
        content = read_envelopes(path.parent)
        inputs, name = envelope_inputs(self.suite, setting), content["env"].rpartition("-v")[0]
        if name == setting.environment.id.rpartition("-v")[0]:
            inputs["environment"]["id"] = content["env"]
        check_inputs(inputs, content["inputs"], repr(str(path)))
        refuse_code([entry["vertices"] for entry in content["classes"].values()], str(path))
        return content

    def classes(self, setting: Setting) -> dict[str, Any]:
        """Return the classes of a setting by name, as :meth:`read`."""
        classes: dict[str, Any] = self.read(setting)["classes"]
        return classes

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
        return dict(classes[name])

    def missing(self, setting: Setting, names: Sequence[str]) -> list[Class]:
        """Return the missing ones of these classes, all of whose rules are made once.

        Raises:
            ConfigurationError: as :meth:`read`, or a family that does not fit.
        """
        there = self.classes(setting)
        result = [c for c in classes_of(setting) if c.name in names and c.name not in there]
        for search in searches_of(self.suite, setting, result):
            search.check()
        return result

    def complete(
        self, setting: Setting, required: Sequence[Class], cache: Cache, pool: Pool
    ) -> None:
        """Tune, choose and measure these classes, and write the setting's tables again."""
        suite = self.suite
        searches = searches_of(suite, setting, required)
        longest = sorted(searches, key=lambda search: -len(search.family.parameters))
        side_by_side(missing(run_search, longest, cache), pool, f"{setting.name}: tuning")
        tests: list[Test] = []
        for of in required:
            candidates, _ = candidates_of(setting, of, searches, cache)
            vertices = [candidates[point.name] for point in hull_of_tuned(candidates)]
            tests += rule_tests(setting, vertices, suite.episodes, suite.seed)
        side_by_side(missing(run_test, tests, cache), pool, f"{setting.name}: testing")
        earlier, inputs = self.read(setting), envelope_inputs(suite, setting)
        classes = earlier["classes"]
        for of in required:
            content = content_of(suite, setting, of, searches, cache)
            classes[of.name] = content | {"sha256": digest(inputs, of.name, content)}
        curves = merge_curves(earlier["curves"], list(curves_of(searches, cache)))
        report = {
            "title": setting.title,
            "env": setting.environment.id,
            "options": setting.environment.options,
            "horizon": envelope_task(setting).horizon,
            "always": next(row["rate"] for row in curves if row["family"] == "always"),
            "inputs": inputs,
            "classes": {c.name: classes[c.name] for c in classes_of(setting) if c.name in classes},
            "curves": curves,
        }
        write_envelopes(self.results / setting.name, report)


def merge_curves(earlier: Sequence[Row], new: Sequence[Row]) -> list[Row]:
    """Return each family's curve in each world, once: classes that are added take none away."""
    replaced = [(row["family"], row["options"]) for row in new]
    return [*(r for r in earlier if (r["family"], r["options"]) not in replaced), *new]
