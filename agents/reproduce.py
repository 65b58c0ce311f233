"""Print the documentation's table of filters, triggers and buckets.

    python -m agents.reproduce --config configs/tobit_oscillator_reproduce.yaml

Every row runs on the same seeds. ``--markdown`` prints the table as the documentation holds it.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from rich import box
from rich.table import Table

from agents import tables
from agents.config import Comparison, load_comparison
from agents.progress import progress_bar
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.make import make_policy
from fusion_gym.validation import ConfigurationError

COLUMNS = ("setting", "requests", "rate", "MSE", "median", "ARMSE", "trace P", "NEES")


def run(comparison: Comparison, episodes: int, seed: int) -> list[tuple[str, ...]]:
    """One row of text for each of the config's rows.

    Raises:
        ConfigurationError: a row that is not allowed, before the first episode.
    """
    made = []
    for row in comparison.rows:
        task = make_task(row.environment or comparison.environment, **row.options)
        made.append((row.label, task, make_policy(row.policy, task)))
    total = sum(episodes * task.horizon for _, task, _ in made)
    found = []
    with progress_bar(total, "reproducing") as bar:
        for label, task, policy in made:
            found.append(_cells(label, run_episodes(task, policy, episodes, seed, bar.update)))
    return found


def _cells(label: str, results: EpisodeResults) -> tuple[str, ...]:
    return (
        label,
        " ".join(f"{rate:.3f}" for rate in results.requests.mean(0)),
        f"{results.rate.mean():.3f}",
        tables.number(mean_interval(results.mse)._asdict()),
        f"{np.median(results.mse):.4g}",
        " ".join(f"{error:.3f}" for error in np.sqrt(results.squared_error).mean(0)),
        tables.number(mean_interval(results.bound_trace)._asdict()),
        f"{results.nees.mean():.3f}",
    )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m agents.reproduce",
        description="Print the documentation's table of filters, triggers and buckets.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--config", default="configs/tobit_oscillator_reproduce.yaml")
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    parser.add_argument("--markdown", action="store_true")
    arguments = parser.parse_args()
    try:
        rows = run(load_comparison(arguments.config), arguments.episodes, arguments.seed)
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    if arguments.markdown:
        lines = [COLUMNS, ("---",) * len(COLUMNS), *rows]
        print("\n".join("| " + " | ".join(line) + " |" for line in lines))
        return
    table = Table(
        title=f"{arguments.episodes} episodes, seed {arguments.seed}", box=box.SIMPLE_HEAD
    )
    for column in COLUMNS:
        table.add_column(column, justify="left" if column == "setting" else "right")
    for row in rows:
        table.add_row(*row)
    tables.console().print(table)


if __name__ == "__main__":
    main()
