"""Rules and agents of a class under perturbed cases: pieces of work and their verdict."""

from __future__ import annotations

import glob
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from fusion_gym import zoo
from fusion_gym.core.task import Task
from fusion_gym.evaluation.envelope import best_mse
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError, refusal

from ..output.files import read_json, write
from ..output.folders import fingerprint
from ..training.config import Experiment
from ..training.run import holds_training, train
from .classes import Class
from .config import NOMINAL, Case, Perturbed, Setting, Suite, drawn_world, front_prices, world
from .references import envelope_task
from .training import Folders, agent_options, agent_task, experiment_of
from .verdict import KINDS, MIDDLE, Searches, is_gain, judge, write_cases

RULES = "rules"
Options = tuple[tuple[str, Any], ...]


class RobustEntry(NamedTuple):
    """A policy with the options that it adds to those of the case.

    ``label`` stands for its text among the inputs where that is a file's path; one that is
    ``added`` is no rule of the envelope.
    """

    name: str
    policy: str
    options: Options
    label: str | None = None
    added: bool = False


class RobustPiece(NamedTuple):
    """Some policies in a case: the rules of a class, or an agent at all its prices.

    ``setting`` is the setting as it is in the case.
    """

    setting: Setting
    of: Class
    case: str
    label: str
    entries: tuple[RobustEntry, ...]
    episodes: int
    seed: int

    @property
    def weight(self) -> float:
        """About how long it takes, in seconds on one core."""
        return len(self.entries) * (0.1 + 0.01 * self.episodes)

    @property
    def place(self) -> str:
        """Path of its files in the work folder, without the suffix."""
        return f"{self.setting.name}/{self.of.name}/{self.case}/{self.label}"

    @property
    def inputs(self) -> dict[str, Any]:
        """All that its results depend on."""
        return {
            "environment": self.setting.environment.model_dump(mode="json"),
            "policies": {
                entry.name: {"policy": entry.label or entry.policy, "options": dict(entry.options)}
                for entry in self.entries
            },
            "episodes": self.episodes,
            "seed": self.seed,
        }

    def task(self, entry: RobustEntry) -> Task:
        """The task in which a policy runs."""
        return envelope_task(self.setting, entry.options)


def run_piece(piece: RobustPiece, folders: Folders) -> None:
    """Run the policies of a piece and keep what they did."""
    torch.set_num_threads(1)
    result = {}
    tasks: dict[str, Task] = {}
    for entry in piece.entries:
        same = repr(entry.options)
        task = tasks[same] = tasks[same] if same in tasks else piece.task(entry)
        policy = make_policy(entry.policy, task)
        result[entry.name] = run_episodes(task, policy, piece.episodes, piece.seed)
    report = {
        "made_from": fingerprint(piece.inputs),
        "setting": piece.setting.name,
        "case": piece.case,
        "inputs": piece.inputs,
        "policies": {
            name: {
                "rate": float(item.rate.mean()),
                "mse": mean_interval(item.mse)._asdict(),
                "diverged": float(item.diverged.mean()),
            }
            for name, item in result.items()
        },
    }
    folders.write(piece.place, report, result)


def rules_piece(
    setting: Setting, of: Class, case: str, vertices: Sequence[Mapping[str, Any]], episodes: int,
    seed: int,
) -> RobustPiece:  # fmt: skip
    """The rules of an envelope in a case, and what transmits always."""
    entries = [
        RobustEntry(vertex["name"], vertex["policy"], tuple(vertex["options"].items()))
        for vertex in vertices
    ]
    if "always" not in [entry.name for entry in entries]:
        entries.append(RobustEntry("always", "always", (), added=True))
    return RobustPiece(setting, of, case, RULES, tuple(entries), episodes, seed)


def agent_piece(
    suite: Suite, setting: Setting, of: Class, case: str, label: str, agent: str, episodes: int,
    seed: int,
) -> RobustPiece:  # fmt: skip
    """An agent in a case, at prices over the whole range."""
    text = f"{label} {_digest(agent)}"
    options = tuple(agent_options(setting, of).items())
    entries = tuple(
        RobustEntry(
            f"price={price!r}", f"{agent},price={price!r}", options, f"{text},price={price!r}"
        )
        for price in front_prices(setting.price_range, suite.prices)
    )
    return RobustPiece(setting, of, case, label, entries, episodes, seed)


def _digest(agent: str) -> str:
    """The first half of the SHA-256 of an agent's model."""
    kind, _, name = agent.partition(":")
    path = Path(zoo.model_path(name) if kind == "zoo" else name)
    return hashlib.sha256(path.read_bytes()).hexdigest()[:32]


def agents_of(
    setting: Setting, of: Class, patterns: Sequence[str], models: Path | None, usual: Path
) -> list[str]:
    """The texts of a setting's agents: files that fit patterns, a benchmark's, or the zoo's.

    ``{setting}`` and ``{class}`` in a pattern are filled in. ``models`` is a benchmark's work
    folder, which must hold some if it is given; ``usual`` is looked into otherwise.

    Raises:
        ConfigurationError: there are none.
    """
    if patterns:
        result: list[str] = []
        for pattern in patterns:
            filled = pattern.replace("{setting}", setting.name).replace("{class}", of.name)
            files = sorted(glob.glob(filled))
            if not files and "{setting}" not in pattern:
                raise refusal("agents", pattern, "a file, or a pattern that some file fits")
            result += files
        if not result:
            raise refusal(
                "agents", list(patterns), f"patterns that some file of {setting.name} fits"
            )
        return [f"model:{path}" for path in result]
    folder = usual if models is None else models
    result = [
        f"model:{path}"
        for path in sorted(folder.glob(f"{setting.name}/{of.name}_[0-9]*/best_model.zip"))
    ]
    if result:
        return result
    if models is not None:
        raise refusal("models", str(models), f"a folder with agents {setting.name}/{of.name}_SEED")
    name = f"{setting.name}_{of.name}"
    if name not in zoo.names():
        raise ConfigurationError(
            f"agents = () is not allowed: neither {str(usual)!r} nor the zoo has agents of "
            f"{setting.name} in the class {of.name!r}; name files, or train some"
        )
    return [f"zoo:{name}"]


def training(suite: Suite, setting: Setting, of: Class, seed: int, work: Path) -> Experiment:
    """The training of an agent over draws, the benchmark's in all else."""
    return experiment_of(suite, setting, of, seed, work / "trained")


def run_training(experiment: Experiment) -> None:
    """Train as far as it is not."""
    folder = Path(experiment.output)
    if not train(experiment, resume=holds_training(folder), quiet=True)["finished"]:
        raise KeyboardInterrupt


Rules = Mapping[str, EpisodeResults]


def judge_case(
    pieces: Mapping[str, RobustPiece],
    nominal: RobustPiece,
    prices: Sequence[float],
    searches: Searches,
    folders: Folders,
) -> dict[str, Any]:
    """A case: what it does to the rules, and every kind of agent beside them.

    ``pieces`` are its finished pieces by label, ``nominal`` that of the rules as assumed, and
    ``searches`` what each tuning seed alone would have made of the envelope.
    """
    before = folders.read(nominal.place)[1]
    middle = math.sqrt(MIDDLE[0] * MIDDLE[1]) * float(before["always"].rate.mean())
    every = folders.read(pieces[RULES].place)[1]
    always = float(every["always"].rate.mean())
    envelope = _without_added(every, pieces[RULES])
    row: dict[str, Any] = {
        "always": always,
        "rules": error_change(_without_added(before, nominal), envelope, middle),
    }
    for kind, prefix in KINDS.items():
        tested = [
            list(folders.read(piece.place)[1].values())
            for label, piece in pieces.items()
            if label.startswith(prefix)
        ]
        if tested:
            row[kind] = judge(tested, prices, envelope, {}, always, searches=searches)
    return row


def with_shares(cases: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The cases, with what each leaves of the nominal gain of every kind of agent."""
    for kind in KINDS:
        for row in cases.values():
            left = _left(row.get(kind), cases[NOMINAL].get(kind))
            if left is not None:
                row[kind]["left"] = left
    return cases


def _without_added(rules: Rules, piece: RobustPiece) -> Rules:
    added = {entry.name for entry in piece.entries if entry.added}
    return {name: rule for name, rule in rules.items() if name not in added}


def error_change(nominal: Rules, case: Rules, rate: float) -> dict[str, float] | None:
    """The relative change of the rules' error at a rate, with its interval over paired episodes.

    That of a ratio of means, by its linear part; ``None`` left of either's first rule.
    """
    before, after = best_mse(nominal, rate), best_mse(case, rate)
    if before is None or after is None:
        return None
    ratio = float(after.mean() / before.mean())
    linear = ratio - 1.0 + (after - ratio * before) / before.mean()
    return mean_interval(np.asarray(linear))._asdict()


def _left(row: Mapping[str, Any] | None, nominal: Mapping[str, Any] | None) -> float | None:
    """The gain of a case as a share of the nominal one, where that is no accident."""
    if row is None or nominal is None or "middle" not in row or "middle" not in nominal:
        return None
    before = nominal["middle"]
    return float(row["middle"]["mean"] / before["mean"]) if is_gain(before) else None


class RobustTrial(NamedTuple):
    """What is to be tried in a setting.

    ``worlds`` are the setting as it is in each case, by name and the nominal one first, with
    ``titles``; ``agents`` the texts of agents, and ``seeds`` those of trainings over draws.
    """

    suite: Suite
    setting: Setting
    of: Class
    envelope: dict[str, Any]
    worlds: dict[str, Setting]
    titles: dict[str, str]
    drawn: Setting
    agents: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: int
    folders: Folders

    @classmethod
    def create(
        cls, suite: Suite, setting: Setting, perturbed: Perturbed, cases: Sequence[Case], of: Class,
        envelope: dict[str, Any], agents: Sequence[str], trained: bool, episodes: int,
        folders: Folders,
    ) -> RobustTrial:  # fmt: skip
        """Every case is made once before anything runs.

        Raises:
            ConfigurationError: a case that the setting cannot have, an agent that does not fit, or
                no draws to train over; says which.
        """
        worlds = {case.name: world(setting, case) for case in cases}
        drawn = drawn_world(setting, perturbed)
        for name, item in [*worlds.items(), ("drawn", drawn)]:
            try:
                agent_task(item, of)
            except ConfigurationError as error:
                raise ConfigurationError(f"{name} of {setting.name}: {error}") from None
        for agent in agents:
            make_policy(agent, agent_task(setting, of))
        if trained and not perturbed.drawn:
            raise ConfigurationError(
                f"trained = True is not allowed with {setting.name}: the config has no 'drawn' "
                "options for it"
            )
        return cls(
            suite=suite,
            setting=setting,
            of=of,
            envelope=envelope,
            worlds=worlds,
            titles={case.name: case.title for case in cases},
            drawn=drawn,
            agents=tuple(agents),
            seeds=tuple(range(suite.training_seeds)) if trained else (),
            episodes=episodes,
            folders=folders,
        )

    @property
    def trainings(self) -> list[Experiment]:
        """The trainings over draws."""
        return [
            training(self.suite, self.drawn, self.of, seed, self.folders.work)
            for seed in self.seeds
        ]

    @property
    def labels(self) -> dict[str, dict[str, str]]:
        """The text of every agent, by its kind and label."""
        outputs = [Path(experiment.output) for experiment in self.trainings]
        return {
            "agents": {f"agent_{place}": text for place, text in enumerate(self.agents)},
            "trained": {
                f"trained_{seed}": f"model:{output / 'best_model.zip'}"
                for seed, output in zip(self.seeds, outputs, strict=True)
            },
        }

    def pieces(self, kinds: Sequence[str], cases: Sequence[str] = ()) -> Iterator[RobustPiece]:
        """The work of some kinds of agents, and with ``"rules"`` theirs, in some cases (none: all).

        Raises:
            OSError: an agent's file cannot be read.
        """
        requested = (self.episodes, self.suite.seed)
        for case in cases or self.worlds:
            single = self.worlds[case]
            if RULES in kinds:
                yield rules_piece(single, self.of, case, self.envelope["vertices"], *requested)
            for kind in kinds:
                for label, agent in self.labels.get(kind, {}).items():
                    yield agent_piece(self.suite, single, self.of, case, label, agent, *requested)

    def judge(self, case: str) -> None:
        """Judge a case, all of whose pieces are finished, and keep that."""
        (nominal,) = self.pieces((RULES,), (NOMINAL,))
        row = judge_case(
            {piece.label: piece for piece in self.pieces((RULES, *KINDS), (case,))},
            nominal,
            front_prices(self.setting.price_range, self.suite.prices),
            self.envelope["searches"],
            self.folders,
        )
        write(self._verdict(case), {"title": self.titles[case]} | row)

    def write_verdict(self) -> None:
        """Put all cases, each of which is judged, into the setting's verdict."""
        cases = {case: read_json(self._verdict(case), "work") for case in self.worlds}
        report = {
            "setting": self.setting.name,
            "class": self.of.name,
            "episodes": self.episodes,
            "sha256": self.envelope["sha256"],
            "cases": with_shares(cases),
        }
        write_cases(self.folders.results / self.setting.name, report)

    def _verdict(self, case: str) -> Path:
        return self.folders.work / self.setting.name / self.of.name / case / "verdict.json"
