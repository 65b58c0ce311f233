"""Committed envelopes: every class's strongest rules, chosen on tuning seeds, measured on others.

What is tuned and what is tested lies in the work folder under names that hold a hash of all that
it was made from; ``envelopes/SETTING.json`` in the results folder holds the classes.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion_gym.core.system import Knowledge, covers
from fusion_gym.core.task import Task
from fusion_gym.deprecation import replace_value
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import EnvelopePoint, lower_hull, points_of
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from ..output.files import load_results, read_json, save_results, write
from ..output.folders import fingerprint
from .classes import Class, classes_of
from .config import Family, Setting, Suite, Tuning
from .tuning import as_they_are, first_values, policy_text, tune_families

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
