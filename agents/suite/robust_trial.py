"""A setting under all its cases: its worlds, its agents, its pieces of work and its verdict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from ..output.files import read_json, write
from ..training.config import Experiment
from .classes import Class
from .config import Setting, Suite
from .fronts import front_prices
from .jobs import agent_task
from .robust_pieces import RULES, RobustFolders, RobustPiece, agent_piece, rules_piece, training
from .robust_summary import KINDS, write_cases
from .robust_table import judge_case, with_shares
from .robustness import NOMINAL, Case, Perturbed, drawn_world, world


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
    folders: RobustFolders

    @classmethod
    def create(
        cls, suite: Suite, setting: Setting, perturbed: Perturbed, cases: Sequence[Case], of: Class,
        envelope: dict[str, Any], agents: Sequence[str], trained: bool, episodes: int,
        folders: RobustFolders,
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

    def conclude(self) -> None:
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
