"""Reproduce the simulation sections of the five papers: figures, tables and claims.

    python -m agents.papers tobit_token_bucket
    python -m agents.papers all --resume
    python -m agents.papers markov_jump --figure 5 --set m=0.7 --episodes 200

Into the output folder go a page a paper (``PAPER.md``), its figures (PNG and SVG), its numbers
(``PAPER.json``), and ``README.md`` with every claim's verdict. With ``--figure`` one figure alone
is simulated and drawn, under other parameters of the paper or options of its environment.
Simulations are kept in the work folder as they are finished; ``--resume`` skips those, if they
were made from the same inputs by the same code.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from agents.cache import Cache
from agents.papers import page
from agents.papers.numbers import LARGER, UNDECIDED
from agents.papers.paper import (
    NAMES,
    NOTHING,
    Data,
    Paper,
    Piece,
    PieceJob,
    Settings,
    load_paper,
    load_papers,
)
from agents.workers import Call, Pool, run_parallel
from fusion_gym.commands.command_line import Long, SetOptions
from fusion_gym.commands.options import OUTPUT_FOLDER, Seed, whole
from fusion_gym.entries import Plain
from fusion_gym.errors import forbidden, refusal
from fusion_gym.output.ending import ended_like_by_ctrl_c
from fusion_gym.output.files import lock_folder, read_json
from fusion_gym.output.progress import writing
from fusion_gym.policies.settings import parse_settings
from fusion_gym.validation import ConfigurationError, integer

_SHARE = 0.1  # of the episodes, for a check


@dataclass(frozen=True)
class Reproduce(Long):
    """Reproduce the simulation sections of the five papers."""

    program = "python -m agents.papers"

    papers: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar=f"{{{','.join(NAMES)},all}}")
    ]
    """Papers by name, or all."""
    figure: str | None = None
    """One figure of one paper, by its number or name, instead of pages."""
    options: SetOptions = ()
    """Parameters of the figure, or options of the paper's environment."""
    episodes: Annotated[int | None, whole(2, 100_000_000)] = None
    """Episodes of every simulation, instead of its own number."""
    seed: Seed = 0
    """Seed of the first episode."""
    check: bool = False
    """Judge by a tenth of the episodes, and fail where a verdict contradicts the pages."""
    resume: bool = False
    """Reuse finished simulations."""
    output: Annotated[Path | None, OUTPUT_FOLDER] = None
    """Folder for pages, figures and numbers: docs/reproduction, or runs/figures for a figure."""
    work: Annotated[Path, OUTPUT_FOLDER] = Path("runs/reproduction")
    """Folder for simulations."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""

    def run(self) -> None:
        """Simulate missing pieces, then write every page, or the figure."""
        papers = load_papers(self.papers)
        changes = parse_settings("option", itertools.chain(*self.options))
        if self.figure is not None:
            if len(papers) != 1:
                allowed = "a single paper"
                raise refusal("papers", self.papers, allowed, f"with figure = {self.figure!r}")
            self._reproduce_figure(papers[0], self.figure, changes)
        elif changes:
            reason = "the claims of the pages need the papers' parameters"
            raise forbidden("set", next(iter(changes)), reason, "without --figure")
        elif self.check:
            self._check_verdicts(papers, self.output or Path("docs/reproduction"))
        else:
            self._reproduce_pages(papers, self.output or Path("docs/reproduction"))

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
            (paper.name, reading, piece.name): self._job(
                piece, paper.settings(changes), factor=factor
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

    def _reproduce_figure(self, paper: Paper, name: str, changes: Plain) -> None:
        name, figure = paper.figure(name)
        settings = paper.settings(changes, figure.without)
        path = (self.output or Path("runs/figures")) / paper.name / name
        with ended_like_by_ctrl_c(), lock_folder(self.work, "work"):
            job = self._job(paper.piece(figure.piece), settings, figure.restriction)
            page.write_figure(figure, self._simulate([job])[0], path)
        print(f"{paper.name}: {path}.png")

    def _job(
        self, piece: Piece, settings: Data, restriction: Settings = NOTHING, factor: float = 1.0
    ) -> PieceJob:
        episodes = max(round(factor * (self.episodes or piece.usual)), 2)
        return PieceJob(piece, episodes, self.seed, settings, dict(restriction))

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


def reproduce_figure(
    paper: str, figure: str, episodes: int | None = None, seed: int = 0, **changes: Any
) -> Any:
    """Return a figure of a paper as a matplotlib Figure, simulated under changed parameters.

    Args:
        paper: The paper's name.
        figure: The figure's number or name.
        episodes: Episodes of the simulation, instead of the paper's own number.
        seed: Seed of the first episode.
        **changes: Parameters of the paper, or options of its environment.

    Raises:
        ConfigurationError: an unknown name, or a value that is not allowed.
    """
    item = load_paper(paper)
    drawing = item.figure(figure)[1]
    settings, piece = item.settings(changes, drawing.without), item.piece(drawing.piece)
    count = integer("episodes", piece.usual if episodes is None else episodes, at_least=2)
    first = integer("seed", seed, at_least=0)
    return page.draw_figure(drawing, piece.simulate(count, first, settings, **drawing.restriction))
