r"""Compare policies at equal communication: at equal rates, and at equal prices of a token.

    fusion-gym compare --env fusion_gym/LinearFusion-v2 --output runs/rules \
        --policies innovation_threshold value_of_information \
        dynamic_event:scale={value}

Each rule runs over its first parameter, its parameter ``price`` or the place of ``{value}``, unless
its text sets the parameter. An agent of several prices runs at all. Two tables show the MSE at
equal rates, where a curve mixes its neighbouring policies, and the least cost of each curve, error
+ price · tokens, at equal prices: over the environment's ``price_range``, or around its price. The
difference is to the best of the other curves. All policies run on the same episodes.

The output folder contains ``evaluation.json`` (every policy), ``comparison.json`` (the tables) and
``pareto.png`` (the curves).
"""

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.table import Table

from fusion_gym.commands.command_line import (
    OUTPUT_FOLDER,
    EnvironmentOptions,
    Episodes,
    Long,
    PolicyNames,
    Seed,
    whole,
)
from fusion_gym.commands.evaluate import evaluation_report
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain
from fusion_gym.envs.registration import class_name, make_task
from fusion_gym.evaluation import curves
from fusion_gym.evaluation.episodes import EpisodeResults, run_several
from fusion_gym.output import tables
from fusion_gym.output.files import write
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.registry import make_policy, policy_names
from fusion_gym.validation import refusal

Compared = Mapping[float, Mapping[str, curves.PairedComparison | None]]  # curves at rates or prices
_RATES = 0.1, 0.25, 0.5, 0.75  # shares of the highest rate


@dataclass(frozen=True)
class Compare(EnvironmentOptions, Long):
    """Compare policies at equal communication: at equal rates, and at equal prices of a token."""

    output: Annotated[Path, OUTPUT_FOLDER]
    """Folder for the results."""
    policies: PolicyNames = ()
    """Rules and references by name, zoo:NAME, or model:PATH."""
    episodes: Episodes = 1000
    """Episodes of each policy."""
    seed: Seed = 0
    """Seed of the first episode."""
    prices: Annotated[int, whole(2, 1000)] = 5
    """Number of prices of the table, at which agents run."""

    keeps = False

    def run(self) -> None:
        """Run all policies on the same episodes, and write, print and draw the comparison."""
        self.costs()

    def costs(self) -> Compared:
        """Run the command, and return the costs at each price."""
        # Imported here, because matplotlib takes a third of a second to load.
        from fusion_gym.output import figures

        env_id, options = self.environment()
        task = make_task(env_id, **options)
        names = list(dict.fromkeys(itertools.chain(*self.policies)))
        if not names:
            raise refusal("policies", names, "one or more: --policies NAME …")
        span = task.reward.price.span
        prices = [] if span is None else _prices(*span, self.prices)
        texts = {name: curves.sweep(task, name, prices) for name in names}
        writing(("evaluation, comparison and figure", self.output))
        every = list(dict.fromkeys(itertools.chain(*texts.values())))
        results = self.run_all(task, every)
        for name in names:
            if name.partition(":")[0] in policy_names("agent"):
                from fusion_gym.training.callbacks import warn_of_unused_tokens

                warn_of_unused_tokens(task, float(results[texts[name][0]].tokens.mean()))
        label = short_text if len({*map(short_text, names)}) == len(names) else str
        rules = {label(name): {text: results[text] for text in texts[name]} for name in names}
        low, high = span or curves.usual_prices(task, results)
        most = max(float(np.nanmean(item.rate)) for item in results.values())
        rates: Compared = {
            rate: curves.compare({n: curves.error_at_rate(c, rate) for n, c in rules.items()})
            for rate in (most * share for share in _RATES)
        }
        costs: Compared = {
            price: curves.compare({n: curves.cost_at_price(c, price) for n, c in rules.items()})
            for price in prices or _prices(low, high, self.prices)
        }
        report = evaluation_report(env_id, task, self.episodes, self.seed, results)
        write(self.output / "evaluation.json", report)
        comparison = {"rates": _plain("rate", rates), "prices": _plain("price", costs)}
        write(self.output / "comparison.json", comparison)
        name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", class_name(env_id)).capitalize()
        title = f"{name}, {task.sensors} sensor{'s' * (task.sensors > 1)}"
        rate_title = f"{title}: MSE at equal rate, transmissions per sensor and step"
        tables.console().print(_table(rate_title, "rate", rates))
        price_title = f"{title}: cost at equal price, error + price · tokens per step"
        tables.console().print(_table(price_title, "price", costs))
        lines = [figures.FigureLine(label, list(own.values())) for label, own in rules.items()]
        title += f": {self.episodes} episodes"
        figures.pareto(self.output / "pareto.png", title, lines, (low, high))
        return costs

    def run_all(self, task: Task, policies: list[str]) -> dict[str, EpisodeResults]:
        """Run every policy on the same seeds, with a progress bar."""
        built = [make_policy(name, task) for name in policies]
        with progress_bar(len(policies) * self.episodes * task.horizon, "comparing") as bar:
            results = run_several(task, built, self.episodes, self.seed, bar.update)
        return dict(zip(policies, results, strict=True))


def _prices(low: float, high: float, count: int) -> list[float]:
    """Return prices over a range, with its exact ends."""
    return [low, *(float(f"{price:.4g}") for price in np.geomspace(low, high, count)[1:-1]), high]


def short_text(policy: str) -> str:
    """Return the text of a policy, without the folder of a file."""
    return re.sub(r"^(model:)[^,]*/", r"\1", policy)


def _plain(place: str, compared: Compared) -> list[Plain]:
    return [
        {place: number, "policies": {name: own and own.plain() for name, own in row.items()}}
        for number, row in compared.items()
    ]


def _table(title: str, place: str, compared: Compared) -> Table:
    """Return the table of the curves, with one column for each rate or price."""
    heads = "policy", *(f"{place} {number:.3g}" for number in compared)
    labels = next(iter(compared.values()))
    rows = ([label, *(cell(row[label]) for row in compared.values())] for label in labels)
    caption = "mean; below it, the paired difference to the best other policy ± 95 % half width"
    return tables.table_tables(title, heads, rows, caption)


def cell(comparison: curves.PairedComparison | None) -> str:
    """Return a comparison as text."""
    if comparison is None:
        return "–"
    share, low, high = (100.0 * part for part in comparison.relative)
    if math.isnan(share):
        return f"{comparison.mean:.4g}"
    digits = 0 if abs(share) > 10.0 else 1
    change = f"{share:+.{digits}f} ± {(high - low) / 2:.{digits}f} %"
    return f"{comparison.mean:.4g}\n{change if share < 1000.0 else '> +1000 %'}"
