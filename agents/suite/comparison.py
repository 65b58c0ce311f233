"""One policy against the lower envelope of swept baselines: tables, files and a figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from fusion_gym.core.task import Task
from fusion_gym.evaluation.envelope import Comparison, compare_with_envelope, lower_envelope
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.metrics import robust_summary, summarise
from fusion_gym.policies.registry import make_policy

from ..output import figures, tables
from ..output.files import write
from ..output.progress import progress_bar
from .sweep import Sweep


def run_all(
    task: Task,
    policies: list[str],
    episodes: int,
    seed: int,
    description: str,
    *,
    trust: bool = False,
) -> dict[str, EpisodeResults]:
    """Every policy on the same seeds, with a progress bar; ``trust`` as in ``make_policy``."""
    made = {name: make_policy(name, task, trust=trust) for name in policies}
    total = len(policies) * episodes * task.horizon
    with progress_bar(total, description) as bar:
        return {
            name: run_episodes(task, policy, episodes, seed, bar.update)
            for name, policy in made.items()
        }


def compare(
    env_id: str, task: Task, sweep: Sweep, baselines: dict[str, EpisodeResults], agent: str,
    seed: int, folder: Path, trust: bool = False,
) -> None:  # fmt: skip
    """Run the agent on the baselines' episodes; write, print and draw the comparison.

    Raises:
        ConfigurationError: the agent transmits less than every baseline.
    """
    episodes = next(iter(baselines.values())).episodes
    learned = run_all(task, [agent], episodes, seed, "agent", trust=trust)[agent]
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
    write(folder / "comparison.json", verdict)
    shown = dict.fromkeys([*sweep.points, *(point.name for point in envelope), agent])
    console = tables.console()
    console.print(
        tables.evaluation_table(
            f"{env_id}: single policies, the lower envelope of all {len(baselines)} baselines, "
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
    figures.pareto(folder / "pareto.png", env_id, lines, points, {label: learned}, envelope)


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
        # Whoever always transmits over a perfect channel has no error to compare with.
        f"{comparison.difference.mean / comparison.envelope:+.1%}" if comparison.envelope else "–",
        "\n".join(comparison.between),
    )
    return table
