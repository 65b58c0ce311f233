"""Print the documentation's table of filters, triggers and buckets.

    python -m agents.papers.table --config tobit_oscillator_reproduce

Every row runs on the same seeds.
"""

from dataclasses import dataclass

import numpy as np

from fusion_gym.commands.command_line import Episodes, Long, Seed
from fusion_gym.docstrings import table
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.metrics import mean_interval
from fusion_gym.output import tables
from fusion_gym.output.progress import progress_bar
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.config import SweepSettings, load_checked

COLUMNS = ("setting", "requests", "rate", "MSE", "median", "ARMSE", "trace P", "NEES")


@dataclass(frozen=True)
class Table(Long):
    """Print the documentation's table of filters, triggers and buckets."""

    program = "python -m agents.papers.table"

    config: str = "tobit_oscillator_reproduce"
    """The rows: a YAML file, or the name of a shipped config."""
    episodes: Episodes = 2000
    """Episodes of each row."""
    seed: Seed = 0
    """Seed of the first episode."""

    keeps = False

    def run(self) -> None:
        """Run every row and print the table."""
        settings = load_checked(SweepSettings, self.config)
        print(table(COLUMNS, _rows_of(settings, self.episodes, self.seed)))


def _rows_of(comparison: SweepSettings, episodes: int, seed: int) -> list[tuple[str, ...]]:
    """Return one row of text for each of the config's rows."""
    result = []
    for row in comparison.rows:
        task = make_task(row.environment or comparison.environment, **row.options)
        result.append((row.label, task, make_policy(row.policy, task)))
    total = sum(episodes * task.horizon for _, task, _ in result)
    results = []
    with progress_bar(total, "rows") as bar:
        for label, task, policy in result:
            bar.say(label)
            results.append(_cells(label, run_episodes(task, policy, episodes, seed, bar.update)))
    return results


def _cells(label: str, results: EpisodeResults) -> tuple[str, ...]:
    return (
        label,
        " ".join(f"{rate:.3f}" for rate in results.requests.mean(0)),
        f"{results.rate.mean():.3f}",
        tables.table_number(mean_interval(results.mse)._asdict()),
        f"{np.median(results.mse):.4g}",
        " ".join(f"{error:.3f}" for error in np.sqrt(results.squared_error).mean(0)),
        tables.table_number(mean_interval(results.bound_trace)._asdict()),
        f"{results.nees.mean():.3f}",
    )


if __name__ == "__main__":
    Table.main()
