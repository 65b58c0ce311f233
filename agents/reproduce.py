"""Make the simulation sections of the five papers anew: figures, tables and claims.

    fusion-gym reproduce tobit_token_bucket
    fusion-gym reproduce all --resume

Into the output folder go a page a paper (``PAPER.md``), its figures (PNG and SVG), its numbers
(``PAPER.json``), and ``README.md`` with every claim's verdict. Simulations are kept in the work
folder as they are finished; ``--resume`` skips those, if they were made from the same inputs.
"""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from .command_line import Command, start
from .input.options import OutputFolder, Seed, Whole
from .output.ending import ended_like_by_ctrl_c
from .output.files import remove_partials
from .output.folders import alone_in
from .reproduction.making import Job, make, shown
from .reproduction.page import write_overview, write_page
from .reproduction.paper import Paper, Piece
from .reproduction.papers import NAMES, papers
from .suite.team import Team
from .suite.workers import Work, side_by_side


@dataclass(frozen=True)
class Reproduce(Command):
    """Make the simulation sections of the five papers anew."""

    papers: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar=f"{{{','.join(NAMES)},all}}")
    ]
    """Papers by name, or all."""
    episodes: Annotated[int | None, Whole(2, 100_000_000)] = None
    """Episodes of every simulation, instead of its own number."""
    seed: Seed = 0
    """Seed of the first episode."""
    resume: bool = False
    """Keep simulations that are finished."""
    output: Annotated[Path, OutputFolder()] = Path("docs/reproduction")
    """Folder for pages, figures and numbers."""
    work: Annotated[Path, OutputFolder()] = Path("runs/reproduction")
    """Folder for simulations."""
    workers: Annotated[int, Whole(1, 512)] = 2
    """Processes side by side."""

    def run(self) -> None:
        """Simulate what is not there, then write every page.

        Raises:
            ConfigurationError: no paper, or one that there is not.
        """
        chosen = papers(self.papers)
        jobs = {
            one.name: {piece.name: self._job(one, piece) for piece in one.pieces} for one in chosen
        }
        with ended_like_by_ctrl_c(), alone_in(self.work, "work"):
            for one in chosen:
                remove_partials(self.work / one.name)
            every = [job for some in jobs.values() for job in some.values()]
            left = [job for job in every if not (self.resume and job.finished())]
            print(f"simulations go into {self.work}, pages into {self.output}", file=sys.stderr)
            work = [
                Work(job.find().weight * job.episodes / job.find().usual, make, (job,))
                for job in left
            ]
            side_by_side(work, Team(self.workers), "reproducing")
            for one in chosen:
                made = {
                    name: {"episodes": job.episodes, "seed": job.seed}
                    for name, job in jobs[one.name].items()
                }
                write_page(one, shown(one, jobs[one.name]), made, self.output)
                print(f"{one.name}: {self.output / one.name}.md")
            write_overview(self.output)

    def _job(self, one: Paper, piece: Piece) -> Job:
        return Job(one.name, piece.name, self.episodes or piece.usual, self.seed, self.work)

    def interrupted(self) -> str:
        """Finished simulations are kept."""
        words = [word for word in sys.argv[1:] if word != "--resume"]
        command = shlex.join(["fusion-gym", "reproduce", *words, "--resume"])
        return f"interrupted; go on with: {command}"


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Reproduce)
