"""Tune the rules of every setting and class, and commit their envelopes before agents are trained.

    fusion-gym envelope [--envs NAME …] [--classes NAME …] [--quick] [--resume]

For each class of knowledge the vertices of the lower envelope are chosen on tuning seeds and then
measured on the test seeds. The tables of ``SETTING`` in the results folder hold them, each class
with a SHA-256 of its content, which ``fusion-gym benchmark`` keeps with every agent that it trains;
``envelopes/README.md`` has the table. What was tuned stays in the work folder, so that an
interrupted run goes on where it was.
"""

from dataclasses import dataclass

from fusion_gym.validation import choice

from .command_line import SuiteCommand
from .experiments.classes import classes_of
from .experiments.config import load_suite
from .experiments.references import (
    ENVELOPES,
    committed_classes,
    complete_envelopes,
    missing_classes,
)
from .experiments.report import envelopes_text
from .experiments.training import Folders
from .experiments.workers import Pool
from .input.options import writable_folder
from .output.files import write_text
from .output.folders import refuse_earlier
from .output.progress import writing


@dataclass(frozen=True)
class Envelope(SuiteCommand):
    """Tune the rules of every setting and class, and commit their envelopes."""

    def run(self) -> None:
        """Do all work that is not finished, and write the table."""
        suite = load_suite(self.config, self.quick)
        folders = Folders.create(self.results, self.work, self.quick)
        writable_folder("results", folders.results)
        writable_folder("work", folders.work)
        by_name = {setting.name: setting for setting in suite.settings}
        settings = [by_name[choice("envs", name, by_name)] for name in self.envs or by_name]
        known = dict.fromkeys(c.name for setting in settings for c in classes_of(setting))
        for name in self.classes:
            choice("classes", name, known)
        there = [
            name
            for setting in settings
            for name in committed_classes(suite, setting, folders.results)
            if not self.classes or name in self.classes
        ]
        refuse_earlier("results", folders.results, len(there), self.resume)
        for setting in settings:
            missing_classes(suite, setting, self.classes, folders.results)
        with folders.lock():
            writing(
                ("finished envelopes", folders.results),
                ("what was tuned and tested", folders.work),
            )
            complete_envelopes(
                suite, settings, self.classes, folders.results, folders.work, Pool(self.workers)
            )
            readme = folders.results / ENVELOPES / "README.md"
            write_text(readme, envelopes_text(folders.results, "fusion-gym envelope"))
        print(f"envelopes in {folders.results}, the table in {readme}")
