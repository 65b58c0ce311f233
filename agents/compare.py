"""Compare one policy with the lower envelope of swept baselines, at the policy's own rate.

    python -m agents.compare --config configs/biased_oscillator_ppo.yaml \\
        --sweep configs/biased_sweep.yaml \\
        --policy model:runs/biased_oscillator_ppo/best_model.zip --output runs/comparison

All policies run on the same seeds. Into the output folder go ``evaluation.json`` (every policy),
``comparison.json`` (the verdict) and ``pareto.png``.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from agents import figures, tables
from agents.config import Sweep, load_experiment, load_sweep
from agents.evaluate import write
from agents.progress import progress_bar
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import Comparison, compare_with_envelope, lower_envelope
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.metrics import robust_summary, summarise
from fusion_gym.policies.make import make_policy
from fusion_gym.validation import ConfigurationError


def run_all(
    task: Task, policies: list[str], episodes: int, seed: int, description: str
) -> dict[str, EpisodeResults]:
    """Every policy on the same seeds, with a progress bar."""
    made = {name: make_policy(name, task) for name in policies}
    total = len(policies) * episodes * task.horizon
    with progress_bar(total, description) as bar:
        return {
            name: run_episodes(task, policy, episodes, seed, bar.update)
            for name, policy in made.items()
        }


def compare(
    env_id: str,
    task: Task,
    title: str,
    baselines: dict[str, EpisodeResults],
    sweep: Sweep,
    agent: str,
    learned: EpisodeResults,
    seed: int,
    folder: Path,
) -> dict[str, Any]:
    """Write, print and draw the comparison; return the verdict.

    Raises:
        ConfigurationError: the agent transmits less than every baseline.
    """
    comparison = compare_with_envelope(learned, baselines)
    envelope = lower_envelope(baselines)
    results = baselines | {agent: learned}
    report: dict[str, Any] = {
        "env": env_id,
        "episodes": learned.episodes,
        "seed": seed,
        "horizon": task.horizon,
        "settings": task.settings,
        "policies": {name: summarise(found) for name, found in results.items()},
        "quantiles": {name: robust_summary(found) for name, found in results.items()},
    }
    write(folder / "evaluation.json", report)
    verdict = {
        "agent": agent,
        "rate": float(learned.rate.mean()),
        "mse": float(learned.mse.mean()),
        "envelope": comparison.envelope,
        "difference": comparison.difference._asdict(),
        "between": list(comparison.between),
    }
    (folder / "comparison.json").write_text(json.dumps(verdict, indent=1) + "\n")
    shown = dict.fromkeys([*sweep.points, *(point.name for point in envelope), agent])
    console = tables.console()
    console.print(
        tables.evaluation_table(
            f"{title}: single policies, the lower envelope of all {len(baselines)} baselines, "
            "and the agent",
            {name: report["policies"][name] for name in shown},
            report["quantiles"],
            {},
        )
    )
    console.print(comparison_table(comparison, learned))
    lines = [
        figures.Line(curve.label, [baselines[name] for name in curve.policies])
        for curve in sweep.curves
    ]
    points = {name: baselines[name] for name in sweep.points}
    label = "PPO agent" if agent.startswith("model:") else agent
    figures.pareto(folder / "pareto.png", title, lines, points, {label: learned}, envelope)
    return verdict


def comparison_table(comparison: Comparison, learned: EpisodeResults) -> Table:
    """The agent against the envelope at its own rate."""
    table = Table(title="the agent against the lower envelope at its own rate", box=box.SIMPLE_HEAD)
    for name in ("rate", "agent's MSE", "envelope's MSE", "difference [95 %]", "relative"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("envelope between", overflow="fold")
    table.add_row(
        f"{learned.rate.mean():.4f}",
        f"{learned.mse.mean():.4f}",
        f"{comparison.envelope:.4f}",
        tables.difference(comparison.difference),
        f"{comparison.difference.mean / comparison.envelope:+.1%}",
        "\n".join(comparison.between),
    )
    return table


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="python -m agents.compare",
        description="Compare one policy with the lower envelope of swept baselines.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    result.add_argument("--config", required=True, help="a training's YAML: names the environment")
    result.add_argument("--sweep", required=True, help="the baselines' YAML")
    result.add_argument("--policy", required=True, help="for example model:PATH")
    result.add_argument("--output", type=Path, required=True, help="folder for the results")
    result.add_argument("--episodes", type=int, default=1000)
    result.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    return result


def main() -> None:
    """Entry point."""
    given = parser().parse_args()
    try:
        chosen, sweep = load_experiment(given.config).environment, load_sweep(given.sweep)
        task = make_task(chosen.id, **chosen.options)
        make_policy(given.policy, task)
        baselines = run_all(task, sweep.policies, given.episodes, given.seed, "baselines")
        learned = run_all(task, [given.policy], given.episodes, given.seed, "policy")
        compare(
            chosen.id,
            task,
            chosen.id,
            baselines,
            sweep,
            given.policy,
            learned[given.policy],
            given.seed,
            given.output,
        )
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted")


if __name__ == "__main__":
    main()
