"""How fast agents learn, and how far, in the settings of configs/learning.yaml.

    python -m benchmarks.learning [SETTING …] [--seeds 5] [--workers 2] [--resume] [--quick]

In each setting it trains a front with memory and counterfactual credit with every seed, and plain
PPO for comparison; measures on the way, over the processor's seconds, when a front is below the
committed envelope of rules without memory; runs the finished fronts on the test episodes beside the
envelope of exactly the same information (or the optimum); and measures this machine's steps per
second. The tables in ``OUTPUT/SETTING`` are written anew after every training, ``OUTPUT/README.md``
and a table at the end. Trainings lie in the work folder, and their checkpoints hold pickles:
``--resume`` those of your own alone.
"""

import argparse
import shlex
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fusion_gym.agents.experiments.config import load_learning, load_suite
from fusion_gym.agents.experiments.learning import (
    Kind,
    LearningRun,
    LearningSetup,
    finished_runs,
    read_learning,
    report,
    run_course,
    run_reference,
)
from fusion_gym.agents.experiments.report import learning_table, learning_text
from fusion_gym.agents.experiments.workers import Call, Pool, side_by_side
from fusion_gym.agents.output import tables
from fusion_gym.agents.output.ending import ended_like_by_ctrl_c, report_errors
from fusion_gym.agents.output.files import write, write_text
from fusion_gym.agents.output.folders import alone_in
from fusion_gym.agents.output.progress import quietly, writing
from fusion_gym.validation import ConfigurationError, choice, integer

from .throughput import measured, remembering, vector

_SPEED = 40_000  # steps of a training in a second, about


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    parser = argparse.ArgumentParser(description="How fast agents learn, and how far.")
    parser.add_argument("settings", nargs="*", metavar="SETTING", help="all by default")
    parser.add_argument("--config", default="learning", help="a YAML file or a shipped config")
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each front")
    parser.add_argument("--workers", type=int, default=2, help="processes side by side")
    parser.add_argument("--resume", action="store_true", help="go on with trainings of your own")
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument("--results", type=Path, default=Path("results"), help="with envelopes")
    parser.add_argument("--output", type=Path, help="for tables: results/learning")
    parser.add_argument("--work", type=Path, help="for models and episodes: runs/learning")
    parser.add_argument("--quiet", action="store_true", help="neither progress nor remarks")
    arguments = parser.parse_args()
    words = [word for word in sys.argv[1:] if word != "--resume"]
    again = shlex.join(["python", "-m", "benchmarks.learning", *words, "--resume"])
    interrupted = f"interrupted; go on with: {again}"
    with report_errors(lambda: interrupted), quietly(arguments.quiet), ended_like_by_ctrl_c():
        run(arguments)


def run(args: argparse.Namespace) -> None:
    """Do what is not finished, write and print the tables.

    Raises:
        ConfigurationError: anything that is not allowed, before anything runs.
    """
    integer("seeds", args.seeds, at_least=1)
    integer("workers", args.workers, at_least=1, at_most=512)
    learning = load_learning(args.config, args.quick)
    suite = load_suite(learning.suite)
    output = args.output or Path("results/learning/quick" if args.quick else "results/learning")
    work = args.work or Path("runs/learning/quick" if args.quick else "runs/learning/full")
    by_name = {course.setting: course for course in learning.settings}
    settings = [by_name[choice("setting", name, by_name)] for name in args.settings or by_name]
    studies = [
        LearningSetup(learning, suite, setting, args.results, output, work) for setting in settings
    ]
    for study in studies:
        study.check()
        study.experiment("front", 0)
        study.experiment("plain", 0)
    with alone_in(output, "output"), alone_in(work, "work"):
        there = [study.report for study in studies if study.report.exists()]
        if there and not args.resume:
            raise ConfigurationError(
                f"output = {str(output)!r} holds {there[0].parent.name} already: go on with "
                "--resume, or give another --output and --work"
            )
        writing(("results", output), ("trainings and episodes", work))
        for study in studies:
            measure_throughput(study)
        teach(studies, args.seeds, Pool(args.workers))
        for study in studies:
            report(study, args.seeds)
        folders = [output / name for name in by_name]
        content = [read_learning(path) for path in folders if (path / "learning.csv").exists()]
        write_text(output / "README.md", learning_text(content, _command(args)))
        tables.console().print(learning_table(content))
        print(f"results in {output}")


def _command(arguments: argparse.Namespace) -> str:
    """The command that makes all tables, some settings' or all."""
    words = ["python", "-m", "benchmarks.learning", "--seeds", str(arguments.seeds)]
    words += ["--quick"] if arguments.quick else []
    words += [] if arguments.config == "learning" else ["--config", str(arguments.config)]
    return shlex.join(words)


def teach(studies: Sequence[LearningSetup], seeds: int, pool: Pool) -> None:
    """References, then fronts, then plain PPO for a multiple of the seconds that they took."""
    tests = {test.path(study.work): (test, study.work) for study in studies for test in study.tests}
    side_by_side(
        [Call(2.0, run_reference, pair) for path, pair in tests.items() if not path.exists()],
        pool,
        "references",
    )
    fronts = [LearningRun(study, "front", seed) for seed in range(seeds) for study in studies]
    _side_by_side(fronts, seeds, pool, "front")
    plain = []
    for study in studies:
        if study.memoryless is None:
            continue
        trained = finished_runs(study, "front", seeds)
        taken = statistics.fmean(item["curve"][-1]["cpu_seconds"] for item in trained)
        budget = study.learning.plain.budget * taken
        count = min(seeds, study.learning.plain.seeds)
        plain += [LearningRun(study, "plain", seed, budget) for seed in range(count)]
    _side_by_side(plain, seeds, pool, "plain")


def _side_by_side(lessons: Sequence[LearningRun], seeds: int, pool: Pool, kind: Kind) -> None:
    left = [lesson for lesson in lessons if lesson.result() is None]
    side_by_side(
        [
            Call(lesson.experiment.training.timesteps / _SPEED, run_course, (lesson, seeds))
            for lesson in left
        ],
        pool,
        f"{kind} trainings",
    )


def measure_throughput(study: LearningSetup, seconds: float = 0.3) -> None:
    """Keep the steps per second of the processor in the study's setting, if that was not done."""
    if study.throughput.exists():
        return
    where = study.setting.environment
    clock = time.process_time
    rows = {
        "make_vec": vector(where.options, 1024, where.id, clock),
        "without": remembering(where.id, where.options, "without", clock=clock),
        "values": remembering(where.id, where.options, "values", clock=clock),
    }
    result: dict[str, Any] = {
        name: round(statistics.median(turns)) for name, turns in measured(rows, seconds).items()
    }
    write(study.throughput, result)


if __name__ == "__main__":
    main()
