"""One policy against the lower envelope of swept baselines: tables, files and a figure."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from fusion_gym.core.task import Task
from fusion_gym.evaluation.envelope import BaselineComparison, compare_with_envelope, lower_envelope
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.metrics import robust_summary, summarise
from fusion_gym.policies.registry import make_policy

from ..output import figures, tables
from ..output.files import write
from ..output.progress import progress_bar
from .sweep import Sweep


def run_all(
    task: Task, policies: list[str], episodes: int, seed: int, description: str
) -> dict[str, EpisodeResults]:
    """Run every policy on the same seeds, with a bar of progress."""
    built = {name: make_policy(name, task) for name in policies}
    total = len(policies) * episodes * task.horizon
    with progress_bar(total, description) as bar:
        result = {}
        for name, policy in built.items():
            bar.say(name)
            result[name] = run_episodes(task, policy, episodes, seed, bar.update)
        return result


def compare(
    env_id: str, task: Task, sweep: Sweep, baselines: dict[str, EpisodeResults],
    agents: Sequence[str], seed: int, folder: Path,
) -> None:  # fmt: skip
    """Run the agent, or the agent at each of its prices, on the baselines' episodes.

    Writes, prints and draws the comparison.

    Raises:
        ConfigurationError: the agent transmits less than every baseline.
    """
    episodes = next(iter(baselines.values())).episodes
    learned = run_all(task, list(agents), episodes, seed, "agent")
    result = {name: compare_with_envelope(item, baselines) for name, item in learned.items()}
    envelope = lower_envelope(baselines)
    results = baselines | learned
    report: dict[str, Any] = {
        "env": env_id,
        "episodes": episodes,
        "seed": seed,
        "horizon": task.horizon,
        "settings": task.settings,
        "policies": {name: summarise(result) for name, result in results.items()},
        "quantiles": {name: robust_summary(result) for name, result in results.items()},
    }
    write(folder / "evaluation.json", report)
    points = [_point(name, learned[name], comparison) for name, comparison in result.items()]
    write(folder / "comparison.json", {"points": points})
    visible = dict.fromkeys([*sweep.points, *(point.name for point in envelope), *learned])
    console = tables.console()
    console.print(
        tables.evaluation_table(
            f"{env_id}: single policies, the lower envelope of all {len(baselines)} baselines, "
            "and the agent",
            {name: report["policies"][name] for name in visible},
            report["quantiles"],
            {},
        )
    )
    console.print(comparison_table(result, learned))
    lines = [
        figures.FigureLine(curve.label, [baselines[name] for name in curve.policies])
        for curve in sweep.curves
    ]
    single = {name: baselines[name] for name in sweep.points}
    agent = figures.FigureLine(_label(agents), list(learned.values()))
    figures.pareto(folder / "pareto.png", env_id, lines, single, agent, envelope)


def _point(name: str, learned: EpisodeResults, comparison: BaselineComparison) -> dict[str, Any]:
    return {
        "agent": name,
        "rate": float(learned.rate.mean()),
        "mse": float(learned.mse.mean()),
        "envelope": comparison.envelope,
        "difference": comparison.difference._asdict(),
        "between": list(comparison.between),
    }


def _label(agents: Sequence[str]) -> str:
    if len(agents) > 1:
        return f"the agent, at {len(agents)} prices"
    return "the agent" if agents[0].startswith("model:") else agents[0]


def comparison_table(
    comparisons: Mapping[str, BaselineComparison], learned: Mapping[str, EpisodeResults]
) -> Table:
    """The agent against the envelope, at its own rate at each of its prices."""
    rows = []
    for name, comparison in comparisons.items():
        share = comparison.difference.mean / (comparison.envelope or np.nan)
        row = (
            "\n".join(comparison.between),
            f"{learned[name].rate.mean():.4f}",
            f"{learned[name].mse.mean():.4f}",
            f"{comparison.envelope:.4f}",
            tables.difference(comparison.difference),
            # Whoever always transmits over a perfect channel has no error to compare with.
            "–" if np.isnan(share) else f"{share:+.1%}",
        )
        rows.append(row)
    heads = "rate", "agent's MSE", "envelope's MSE", "difference [95 %]", "relative"
    title = "the agent against the lower envelope at its own rate"
    return tables.table_tables(title, ("envelope between", *heads), rows)
