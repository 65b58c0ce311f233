r"""The benchmark: rules and agents of three knowledge classes in eight tasks.

    python -m agents.benchmark --quick --workers 2
    python -m agents.benchmark --suite channels
    python -m agents.benchmark --class scheduler \
        --policy 'value_of_information:price={price}'

At five prices per knowledge class it tunes the rules of the literature, searches one rule for all
prices, trains agents, and compares all of them on the same test episodes. Into the results folder
go the tables, a figure per task and ``README.md``. With ``--policy`` your own policy is compared
with the best rule of its class; ``{price}`` in its text stands for the price.

Finished pieces of work stay in the work folder, under a hash of their inputs and of the code, and
the same command goes on with the others. They hold pickles.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from agents.benchmark.evidence import check_policy, class_rows, evaluate_policy, gather, point_rows
from agents.benchmark.jobs import Runner
from agents.benchmark.report import print_classes, write_results
from agents.benchmark.settings import ClassName, SuiteName, load_suite
from agents.workers import BackendName, Pool
from fusion_gym.commands.command_line import OUTPUT_FOLDER, Long, whole, writable_folder
from fusion_gym.output.ending import ended_like_by_ctrl_c
from fusion_gym.output.files import lock_folder
from fusion_gym.output.progress import writing
from fusion_gym.validation import refusal


@dataclass(frozen=True)
class Benchmark(Long):
    """The benchmark: rules and agents of three knowledge classes in eight tasks."""

    program = "python -m agents.benchmark"

    suite: SuiteName = "settings"
    """Eight tasks, or two with channels and batteries."""
    settings: tuple[str, ...] = ()
    """Tasks by name; all by default."""
    quick: bool = False
    """Run a small benchmark of three tasks and one seed, in minutes."""
    policy: str | None = None
    """Only compare this policy with the best tuned rule."""
    class_name: Annotated[ClassName | None, tyro.conf.arg(name="class")] = None
    """Knowledge class of the policy."""
    results: Annotated[Path | None, OUTPUT_FOLDER] = None
    """Folder for tables, figures and README.md: results, results/channels, or with --quick
    runs/benchmark/quick/results."""
    work: Annotated[Path, OUTPUT_FOLDER] = Path("runs/benchmark")
    """Folder for finished pieces of work and agents."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""
    backend: BackendName = "loky"
    """Processes of this machine, or a dask cluster."""
    address: str | None = None
    """Address of dask's scheduler; by default, a new cluster on this machine."""

    def run(self) -> None:
        """Run unfinished work, and write the results."""
        if (self.policy is None) != (self.class_name is None):
            raise refusal("class", self.class_name, "given if and only if --policy is given")
        suite = load_suite(self.quick, self.settings, self.suite)
        if self.policy is not None and self.class_name is not None:
            check_policy(suite, self.policy, self.class_name)
        pool = Pool(self.workers, self.backend, self.address)
        work = self.work / ("quick" if self.quick else "full")
        folder = self.results or (work / "results" if self.quick else Path("results"))
        folder = folder if self.results or self.suite == "settings" else folder / self.suite
        writable_folder("results", folder)
        with ended_like_by_ctrl_c(), lock_folder(work, "work"):
            runner = Runner(work.absolute(), pool)
            writing(("finished pieces of work", work))
            if self.policy is not None and self.class_name is not None:
                classes = evaluate_policy(suite, runner, self.policy, self.class_name)
                print_classes(class_rows(classes), point_rows(suite, classes))
                return
            classes = gather(suite, runner)
            write_results(suite, classes, folder)
            print_classes(class_rows(classes), point_rows(suite, classes))
        print(f"results in {folder}")
