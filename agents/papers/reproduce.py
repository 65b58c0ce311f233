"""Reproduce the simulation sections of the five papers: tables, curves and claims.

    python -m agents.papers tobit_token_bucket
    python -m agents.papers all --resume

Into the output folder go a page per paper (``PAPER.md``), its figures, its numbers
(``PAPER.json``), and ``README.md`` with every claim's verdict. Simulations are kept in the work
folder as they are finished; ``--resume`` skips those, if they were made from the same inputs by the
same code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from agents.cache import Cache
from agents.papers import page
from agents.papers.claims import UNDECIDED
from agents.papers.numbers import LARGER
from agents.papers.paper import NAMES, Data, Paper, PieceJob, load_papers
from agents.workers import Call, Pool, run_parallel
from fusion_gym.commands.command_line import OUTPUT_FOLDER, Long, Seed, whole
from fusion_gym.output.ending import ended_like_by_ctrl_c
from fusion_gym.output.files import lock_folder, read_json
from fusion_gym.output.progress import writing
from fusion_gym.validation import ConfigurationError

_SHARE = 0.1  # of the episodes, for a check


@dataclass(frozen=True)
class Reproduce(Long):
    """Reproduce the simulation sections of the five papers."""

    program = "python -m agents.papers"

    papers: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar=f"{{{','.join(NAMES)},all}}")
    ]
    """Papers by name, or all."""
    episodes: Annotated[int | None, whole(2, 100_000_000)] = None
    """Episodes of every simulation, instead of its own number."""
    seed: Seed = 0
    """Seed of the first episode."""
    check: bool = False
    """Judge by a tenth of the episodes, and fail where a verdict contradicts the pages."""
    resume: bool = False
    """Reuse finished simulations."""
    output: Annotated[Path, OUTPUT_FOLDER] = Path("docs/reproduction")
    """Folder for pages, figures and numbers: docs/reproduction by default."""
    work: Annotated[Path, OUTPUT_FOLDER] = Path("runs/reproduction")
    """Folder for simulations."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""

    def run(self) -> None:
        """Simulate missing pieces, then write every page, or check it."""
        papers = load_papers(self.papers)
        (self._check_verdicts if self.check else self._reproduce_pages)(papers, self.output)

    def _reproduce_pages(self, papers: list[Paper], output: Path) -> None:
        with ended_like_by_ctrl_c(), lock_folder(self.work, "work"):
            writing(("simulations", self.work), ("pages", output))
            for factor in (1.0, LARGER):
                undecided = []
                for paper, results, counts in self._judge(papers, factor):
                    claims = page.write_page(paper, results, counts, output)["claims"]
                    print(f"{paper.name}: {output / paper.name}.md")
                    if UNDECIDED in {claim["verdict"] for claim in claims}:
                        undecided.append(paper)
                papers = undecided
            page.write_overview(output)

    def _check_verdicts(self, papers: list[Paper], output: Path) -> None:
        with ended_like_by_ctrl_c(), lock_folder(self.work, "work"):
            differing = []
            for paper, results, counts in self._judge(papers, _SHARE):
                own = page.render_page(paper, results, counts)[1]["claims"]
                stored = read_json(output / f"{paper.name}.json", "numbers")["claims"]
                for new, old in zip(own, stored, strict=True):
                    same = new["verdict"] in (old["verdict"], UNDECIDED)
                    if new["text"] != old["text"] or not (same or old["verdict"] == UNDECIDED):
                        differing.append(f"{new['text']}: {new['verdict']}, not {old['verdict']}")
        if differing:
            raise ConfigurationError(f"other verdicts than in {output}: " + "; ".join(differing))
        print("no verdict contradicts the pages")

    def _judge(
        self, papers: list[Paper], factor: float
    ) -> list[tuple[Paper, dict[str, dict[str, Data]], dict[str, dict[str, int]]]]:
        """Return each paper's data by reading and piece, and the episodes of its pieces."""
        jobs = {
            (paper.name, reading, piece.name): PieceJob(
                piece,
                max(round(factor * (self.episodes or piece.usual)), 2),
                self.seed,
                paper.settings(changes),
            )
            for paper in papers
            for reading, changes in paper.readings.items()
            for piece in paper.pieces
        }
        data = dict(zip(jobs, self._simulate(list(jobs.values())), strict=True))
        return [
            (
                paper,
                {
                    reading: {item.name: data[paper.name, reading, item.name] for item in pieces}
                    for reading in paper.readings
                },
                {item.name: jobs[paper.name, first, item.name].counts for item in pieces},
            )
            for paper in papers
            for pieces, first in [(paper.pieces, next(iter(paper.readings)))]
        ]

    def _simulate(self, jobs: Sequence[PieceJob]) -> list[Data]:
        """Return the data of all jobs, from the work folder or simulated."""
        cache = Cache(self.work)
        if not self.resume:
            for job in jobs:
                cache.drop(*job.key)
        absent = [job for job in jobs if not cache.holds(*job.key)]
        work = [Call(job.weight, job.simulate, (cache,)) for job in absent]
        run_parallel(work, Pool(self.workers), "reproducing")
        return [cache.read(*job.key) for job in jobs]
