"""The benchmark of policies: tuned baselines, learned fronts and references in every setting.

    python -m agents.benchmark [--envs NAME …] [--modes sensors …] [--quick] [--resume]

Every piece of work (a setting's baselines, one training seed of one agent) writes its JSON into
the results folder as it is finished, and its episodes into the work folder; ``--resume`` skips
what is there. ``python -m agents.report`` makes tables and figures of it.
"""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import sys
import time
from pathlib import Path
from typing import Any

import joblib
from tqdm import tqdm

from agents.arrays import load_results
from agents.config import parse
from agents.evaluate import write
from agents.jobs import Folders, Job, jobs, run, setting_task
from agents.suite import COMPARABLE, Setting, Suite, load_suite
from agents.verdict import judge
from fusion_gym.evaluation.envelope import lower_envelope
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.validation import ConfigurationError, choice, integer


def conclude(suite: Suite, setting: Setting, folders: Folders) -> dict[str, Any] | None:
    """The verdict over whatever agents of a setting are finished, written as ``verdict.json``."""
    first = Job(setting, "baselines")
    if not folders.report(first).exists():
        return None
    report = json.loads(folders.report(first).read_text())
    every = load_results(folders.episodes(first))
    ahead = _finished(Job(setting, "informed"), folders)
    known = _finished(Job(setting, "references"), folders)
    clairvoyant = _finished(Job(setting, "hindsight"), folders)
    references = {"sensors": ahead | known, "centre": known, "local": {}}
    always = float(every["always"].rate.mean())
    verdict: dict[str, Any] = {"setting": setting.name, "title": setting.title, "modes": {}}
    for mode in suite.modes:
        done = [Job(setting, "agent", mode, seed) for seed in range(suite.training_seeds)]
        done = [job for job in done if folders.report(job).exists()]
        if not done:
            continue
        comparable = {
            name: every[name]
            for curve in report["curves"].values()
            if curve["knows"] in COMPARABLE[mode]
            for name in curve["policies"]
        }
        agents = [list(load_results(folders.episodes(job)).values()) for job in done]
        prices = json.loads(folders.report(done[0]).read_text())["prices"]
        verdict["modes"][mode] = judge(
            agents, prices, comparable, references[mode], always, clairvoyant
        ) | {"envelope": [point._asdict() for point in lower_envelope(comparable)]}
    write(folders.results / setting.name / "verdict.json", verdict)
    return verdict


def _finished(job: Job, folders: Folders) -> dict[str, EpisodeResults]:
    """The episodes of a job, none if it is not finished or not part of the setting."""
    return load_results(folders.episodes(job)) if folders.report(job).exists() else {}


def execute(suite: Suite, work: list[Job], folders: Folders, workers: int) -> None:
    """Run the jobs on several cores, with an estimate of the remaining time."""
    total = sum(job.weight for job in work)
    began = time.perf_counter()
    with tqdm(total=round(total), desc="benchmark", unit="s of work", smoothing=0.0) as bar:
        finished = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")(
            joblib.delayed(run)(job, suite, folders) for job in work
        )
        for weight in finished:
            bar.update(min(weight, bar.total - bar.n))
    print(f"{len(work)} pieces of work in {time.perf_counter() - began:.0f} s")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="python -m agents.benchmark",
        description="Tuned baselines, learned fronts and references in every setting.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    result.add_argument("--config", default="configs/benchmark.yaml")
    result.add_argument("--envs", nargs="+", metavar="NAME", help="settings, all by default")
    result.add_argument("--modes", nargs="+", help="sensors, centre, local; all by default")
    result.add_argument("--quick", action="store_true", help="less of everything, in minutes")
    result.add_argument("--resume", action="store_true", help="skip what is finished")
    result.add_argument("--results", type=Path, help="folder for JSON (results, or results/quick)")
    result.add_argument("--work", type=Path, help="folder for models and episodes")
    result.add_argument("--workers", type=int, default=2, help="processes side by side")
    result.add_argument("--seeds", type=int, help="training seeds, instead of the config's")
    result.add_argument("--timesteps", type=int, help="of each training, instead of the config's")
    return result


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    given = parser().parse_args()
    kind = "quick" if given.quick else "full"
    folders = Folders(
        given.results or Path("results/quick" if given.quick else "results"),
        given.work or Path("runs/benchmark") / kind,
    )
    # Ended from outside like by Ctrl-C: the workers stop too.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        suite = load_suite(given.config, given.quick)
        changed = {"training_seeds": given.seeds, "timesteps": given.timesteps}
        changed = {key: value for key, value in changed.items() if value is not None}
        suite = parse(Suite, suite.model_dump() | changed, "command line")
        integer("workers", given.workers, at_least=1)
        by_name = {setting.name: setting for setting in suite.settings}
        for name in given.envs or []:
            choice("envs", name, by_name)
        for mode in given.modes or []:
            choice("modes", mode, suite.modes)
        chosen = [by_name[name] for name in given.envs or by_name]
        work = list(jobs(suite, chosen, given.modes or list(suite.modes)))
        done = [
            job for job in work if folders.report(job).exists() and folders.episodes(job).exists()
        ]
        if done and not given.resume:
            raise ConfigurationError(
                f"results = {str(folders.results)!r} holds {len(done)} finished pieces of work: go "
                "on with --resume, or give another --results and --work"
            )
        for setting in chosen:
            setting_task(setting)
        execute(suite, [job for job in work if job not in done], folders, given.workers)
        for setting in chosen:
            conclude(suite, setting, folders)
        print(f"results in {folders.results}: python -m agents.report --results {folders.results}")
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        words = [word for word in sys.argv[1:] if word != "--resume"]
        command = shlex.join(["python", "-m", "agents.benchmark", *words, "--resume"])
        print(f"interrupted; go on with: {command}", file=sys.stderr)
        sys.exit(130)
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    main()
