"""Try rules and agents where the truth is not what they assume: noises, limits, motion, tokens.

    fusion-gym robustness [--envs NAME …] [--class local_packets] [--trained] [--resume]

The rules of a committed envelope and the agents of its class run under every case of a config, as
they were tuned and trained, on the same test episodes. Every piece of work writes what it found and
its episodes into the work folder as it is finished; ``--resume`` skips what is there, if it was
made from the same inputs. The settings' tables in the results folder get the verdicts, which
``robustness/README.md`` there shows. With ``--trained`` agents are trained besides over draws of
the perturbations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fusion_gym.validation import choice

from .command_line import Long
from .experiments.classes import classes_of, trained_classes
from .experiments.config import (
    Perturbed,
    Setting,
    Suite,
    load_robustness,
    load_suite,
    select_settings,
)
from .experiments.config import RobustnessSettings as Config
from .experiments.references import EnvelopeStore
from .experiments.report import robustness_text
from .experiments.robustness import RobustTrial, agents_of, run_piece, run_training
from .experiments.training import Folders
from .experiments.verdict import ROBUSTNESS
from .experiments.workers import Call, Pool, side_by_side
from .input.options import Episodes, InputFolder, OutputFolder, Steps, Whole, writable_folder
from .output.ending import ended_like_by_ctrl_c
from .output.files import write_text
from .output.folders import alone_in, refuse_earlier
from .output.progress import writing
from .training.checked import parse

USUAL = Path("runs/benchmark/full")


@dataclass(frozen=True)
class Robustness(Long):
    """Try rules and agents where the truth is not what they assume."""

    config: str = "robustness"
    """The cases: a YAML file, or the name of a shipped config."""
    envs: tuple[str, ...] = ()
    """Settings by name; none stands for all."""
    of: Annotated[str | None, tyro.conf.arg(name="class")] = None
    """The class of rules and agents, as local_packets; none stands for sensors_memory, and for
    sensors in settings in which nothing is left to remember."""
    agents: tuple[str, ...] = ()
    """Files of agents, patterns with {setting} and {class}; none stands for those of models."""
    models: Annotated[Path | None, InputFolder()] = None
    """A benchmark's work folder with agents, instead of runs/benchmark/full, and of the zoo."""
    trained: bool = False
    """Train agents over draws of the perturbations, and try them too."""
    seeds: Annotated[int | None, Whole(1, 10_000)] = None
    """Number of these trainings in each setting, instead of the suite's."""
    timesteps: Steps = None
    """Steps of each of them, instead of the suite's."""
    episodes: Episodes = 300
    """Test episodes of each policy in each case."""
    resume: bool = False
    """Skip what is finished, go on with trainings of one's own: their checkpoints hold pickles."""
    results: Annotated[Path, OutputFolder()] = Path("results")
    """Folder with the committed envelopes, into which the results go."""
    work: Annotated[Path, OutputFolder()] = Path("runs/robustness")
    """Folder for models and episodes."""
    workers: Annotated[int, Whole(1, 512)] = 2
    """Processes side by side."""

    def run(self) -> None:
        """Do all work that is not finished, judge every case and write the table."""
        with ended_like_by_ctrl_c():
            self._run()

    def _run(self) -> None:
        config = load_robustness(self.config)
        folders = Folders(self.results, self.work)
        trials = [self._trial(config, item, folders) for item in select_settings(config, self.envs)]
        place = self.results / ROBUSTNESS
        writable_folder("results", place)
        there = [
            path
            for trial in trials
            for path in self.work.glob(f"{trial.setting.name}/{trial.of.name}/*/*.npz")
        ]
        refuse_earlier("work", self.work, len(there), self.resume)
        for trial in trials:
            for piece in trial.pieces(("rules", "agents")):
                folders.finished(piece.place, piece.inputs)
        with alone_in(self.results, "results"), alone_in(self.work, "work"):
            writing(("tables", self.results), ("finished pieces and trainings", self.work))
            self._work(trials, ("rules", "agents"), folders)
            trainings = [training for trial in trials for training in trial.trainings]
            if trainings:
                calls = [
                    Call(30.0 + training.training.timesteps / 10_000, run_training, (training,))
                    for training in trainings
                ]
                side_by_side(calls, Pool(self.workers), "trainings over draws")
                self._work(trials, ("trained",), folders)
            rows = [Call(20.0, trial.judge, (case,)) for trial in trials for case in trial.worlds]
            side_by_side(rows, Pool(self.workers), "verdicts")
            for trial in trials:
                trial.write_verdict()
            every = {setting.name: setting.title for setting in load_suite(config.suite).settings}
            titles = {setting.setting: every[setting.setting] for setting in config.settings}
            table = place / "README.md"
            text = robustness_text(self.results, titles, "fusion-gym robustness" + self._how())
            write_text(table, text)
        print(f"results in {self.results}, the table in {table}")

    def _how(self) -> str:
        """The options that the results depend on."""
        seeds = "" if self.seeds is None else f" --seeds {self.seeds}"
        trained = f" --trained{seeds}" if self.trained else ""
        episodes = "" if self.episodes == Robustness.episodes else f" --episodes {self.episodes}"
        return trained + episodes

    def _trial(self, config: Config, entry: Perturbed, folders: Folders) -> RobustTrial:
        """A setting with its agents, everything checked."""
        suite = load_suite(config.suite)
        store = EnvelopeStore(suite, self.results)
        changed = {"training_seeds": self.seeds, "timesteps": self.timesteps}
        changed = {key: value for key, value in changed.items() if value is not None}
        suite = parse(Suite, suite.model_dump() | changed, "command line")
        setting = next(setting for setting in suite.settings if setting.name == entry.setting)
        classes = {of.name: of for of in classes_of(setting)}
        of = classes[choice("class", self.of or _usual_class(suite, setting), classes)]
        agents = agents_of(setting, of, self.agents, self.models, USUAL)
        envelope = store.envelope(setting, of.name)
        return RobustTrial.create(
            suite, setting, entry, config.cases_of(entry), of, envelope, agents,
            self.trained, self.episodes, folders,
        )  # fmt: skip

    def _work(
        self,
        trials: Sequence[RobustTrial],
        kinds: tuple[str, ...],
        folders: Folders,
    ) -> None:
        """Do what is not finished of some kinds."""
        pieces = [piece for trial in trials for piece in trial.pieces(kinds)]
        left = [piece for piece in pieces if not folders.finished(piece.place, piece.inputs)]
        side_by_side(
            [Call(piece.weight, run_piece, (piece, folders)) for piece in left],
            Pool(self.workers),
            " and ".join(kinds),
        )


def _usual_class(suite: Suite, setting: Setting) -> str:
    """The class of a scheduler that knows most."""
    names = [of.name for of in trained_classes(suite, setting)]
    return "sensors_memory" if "sensors_memory" in names else "sensors"
