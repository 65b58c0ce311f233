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

from .command_line import Command
from .experiments.workers import Call as Work
from .experiments.workers import Pool as Team
from .experiments.workers import side_by_side
from .input.options import OutputFolder, Seed, Whole
from .output.ending import ended_like_by_ctrl_c
from .output.files import remove_partials
from .output.folders import alone_in
from .reproduction.making import PieceJob, compute_jobs, results_of
from .reproduction.page import write_overview, write_page
from .reproduction.paper import Paper, Piece
from .reproduction.papers import NAMES, papers


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
        names = papers(self.papers)
        jobs = {
            name.name: {piece.name: self._job(name, piece) for piece in name.pieces}
            for name in names
        }
        with ended_like_by_ctrl_c(), alone_in(self.work, "work"):
            for item in names:
                remove_partials(self.work / item.name)
            every = [job for some in jobs.values() for job in some.values()]
            left = [job for job in every if not (self.resume and job.finished())]
            print(f"simulations go into {self.work}, pages into {self.output}", file=sys.stderr)
            work = [
                Work(job.find().weight * job.episodes / job.find().usual, compute_jobs, (job,))
                for job in left
            ]
            side_by_side(work, Team(self.workers), "reproducing")
            for item in names:
                counts = {
                    name: {"episodes": job.episodes, "seed": job.seed}
                    for name, job in jobs[item.name].items()
                }
                write_page(item, results_of(item, jobs[item.name]), counts, self.output)
                print(f"{item.name}: {self.output / item.name}.md")
            write_overview(self.output)

    def _job(self, paper: Paper, piece: Piece) -> PieceJob:
        return PieceJob(paper.name, piece.name, self.episodes or piece.usual, self.seed, self.work)

    def interrupted(self) -> str:
        """Finished simulations are kept."""
        words = [word for word in sys.argv[1:] if word != "--resume"]
        command = shlex.join(["fusion-gym", "reproduce", *words, "--resume"])
        return f"interrupted; go on with: {command}"
