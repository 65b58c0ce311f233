r"""Compare one policy with swept baselines: at its price, and at its rate.

    fusion-gym compare --config configs/biased_oscillator_ppo.yaml \
        --sweep configs/biased_sweep.yaml \
        --policy model:runs/biased_oscillator_ppo/best_model.zip --output runs/comparison

All policies run on the same seeds. An agent that observes the price of a token, or a rule with a
parameter ``price``, runs at ``--prices`` prices. At each price a table shows the policy and the
baseline of the least cost, where cost = error + price · tokens. At the policy's rate a table shows
its MSE and the MSE of the baselines' lower envelope.

The output folder contains ``evaluation.json`` (every policy), ``comparison.json`` (the comparison)
and ``pareto.png`` (at most five curves, and the costs beside the best baseline's).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from rich.table import Table

from fusion_gym.commands.command_line import OUTPUT_FOLDER, Episodes, Long, Seed, whole
from fusion_gym.commands.evaluate import evaluation_report
from fusion_gym.core.reward import Price
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain
from fusion_gym.envs.registration import class_name, make_task
from fusion_gym.evaluation import metrics
from fusion_gym.evaluation.episodes import EpisodeResults, run_several
from fusion_gym.output import figures, tables
from fusion_gym.output.files import write
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.registry import make_policy, policy_names, policy_parameters
from fusion_gym.training.config import Experiment, Sweep, SweepCurve, load_checked
from fusion_gym.training.run import warn_of_unused_tokens
from fusion_gym.validation import refusal


@dataclass(frozen=True)
class Compare(Long):
    """Compare one policy with swept baselines: at its price, and at its rate."""

    config: str
    """The environment: the YAML file of a training, or the name of a shipped config."""
    sweep: str
    """The baselines: a YAML file, or the name of a shipped sweep."""
    policy: str
    """The policy, for example model:PATH."""
    output: Annotated[Path, OUTPUT_FOLDER]
    """Folder for the results."""
    episodes: Episodes = 1000
    """Episodes of each policy."""
    seed: Seed = 0
    """Seed of the first episode."""
    prices: Annotated[int | None, whole(2, 1000)] = None
    """Run the policy at this many prices over the config's price_range."""

    keeps = False

    def run(self) -> None:
        """Run all policies on the same seeds, and write, print and draw the comparison."""
        self.points()

    def points(self) -> "list[Point]":
        """Run the command, and return the policy at each price."""
        world = load_checked(Experiment, self.config).environment
        sweep = load_checked(Sweep, self.sweep, "sweep")
        task = make_task(world.id, **world.options)
        requested = self.policies_of(task)
        for policy in requested:
            make_policy(policy, task)
        writing(("evaluation, comparison and figure", self.output))
        price, label = task.reward.price, _label(next(iter(requested)))
        baselines = run_all(task, sweep.policies(price), self.episodes, self.seed, "baselines")
        results = run_all(task, list(requested), self.episodes, self.seed, label)
        points = [
            Point(
                name,
                float(item.rate.mean()),
                float(item.mse.mean()),
                metrics.compare_at_price(item, baselines, requested[name]),
                metrics.compare_with_envelope(item, baselines),
            )
            for name, item in results.items()
        ]
        report = evaluation_report(world.id, task, self.episodes, self.seed, baselines | results)
        write(self.output / "evaluation.json", report)
        write(self.output / "comparison.json", {"points": [point.plain() for point in points]})
        if label.endswith("agent"):
            warn_of_unused_tokens(task, float(next(iter(results.values())).tokens.mean()))
        best = dict.fromkeys(point.at_price.best for point in points)
        shown = dict.fromkeys([*sweep.points, *best, *results])
        reports = {name: report["policies"][name] for name in shown}
        title = f"single policies, the best of all {len(baselines)} baselines, and {label}"
        title, console = f"{world.id}: {title}", tables.console()
        console.print(tables.evaluation_table(title, reports, report["quantiles"], {}))
        console.print(rate_table(points))
        console.print(price_table(points, baselines))
        rules = ", ".join(sorted({_rule(name) for name in best}))
        least = [baselines[name] for name in best]
        lines = [
            figures.FigureLine(f"the best rule at each price: {rules}", least),
            *other_curves(price, sweep, baselines, points),
            figures.FigureLine(label, list(results.values())),
        ]
        name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", class_name(world.id)).capitalize()
        sensors = f"{task.sensors} sensor{'s' * (task.sensors > 1)}"
        title = f"{name}, {sensors}: {label} against the best rule at the same price"
        costs = [point.at_price for point in points]
        figures.pareto(self.output / "pareto.png", title, lines, costs)
        return points

    def policies_of(self, task: Task) -> dict[str, float]:
        """Return the policy, or the policy at each price, with the price of a token."""
        if self.prices is None:
            return {self.policy: task.reward.price.middle}
        span = task.reward.price.span
        if span is None:
            reason = "left out, because the config has no price_range"
            raise refusal("prices", self.prices, reason)
        name, _, text = self.policy.partition(":")
        if name not in policy_names() or "price" not in policy_parameters(name):
            reason = f"left out with policy = {self.policy!r}, which takes no price"
            raise refusal("prices", self.prices, reason)
        low, high = (repr(float(end)) for end in span)  # all digits, to stay within the range
        inner = [f"{price:.4g}" for price in np.geomspace(*span, self.prices)[1:-1]]
        # The text of a base may follow; the first text of an agent is its file or name.
        form = "{0}:{1},price={2}" if name in policy_names("agent") else "{0}:price={2},{1}"
        prices = (low, *inner, high)
        return {form.format(name, text, p).rstrip(","): float(p) for p in prices}


def run_all(
    task: Task, policies: list[str], episodes: int, seed: int, description: str
) -> dict[str, EpisodeResults]:
    """Run every policy on the same seeds, with a progress bar."""
    built = [make_policy(name, task) for name in policies]
    with progress_bar(len(policies) * episodes * task.horizon, description) as bar:
        results = run_several(task, built, episodes, seed, bar.update)
    return dict(zip(policies, results, strict=True))


def other_curves(
    price: Price, sweep: Sweep, baselines: Mapping[str, EpisodeResults], points: Sequence["Point"]
) -> list[figures.FigureLine]:
    """Return the best curve of each rule, for three rules that are the best at no price."""
    middle = points[len(points) // 2].at_price.price

    def cost(curve: SweepCurve) -> float:
        items = (baselines[name] for name in curve.policies(price))
        return min(float(item.cost(middle).mean()) for item in items)

    curves: dict[str, SweepCurve] = {}
    for curve in sorted(sweep.curves, key=cost):
        curves.setdefault(_rule(curve.policy), curve)
    best = {_rule(point.at_price.best) for point in points}
    others = [curve for rule, curve in curves.items() if rule not in best][:3]
    return [
        figures.FigureLine(c.label, [baselines[name] for name in c.policies(price)]) for c in others
    ]


class Point(NamedTuple):
    """The policy at one price: its rate per sensor and step, its MSE, and both comparisons."""

    policy: str
    rate: float
    mse: float
    at_price: metrics.PriceComparison
    at_rate: metrics.BaselineComparison

    def plain(self) -> Plain:
        """Return the point as JSON."""
        return self._asdict() | {
            name: comparison._asdict() | {"difference": comparison.difference._asdict()}
            for name, comparison in (("at_price", self.at_price), ("at_rate", self.at_rate))
        }


def _rule(policy: str) -> str:
    """Return the name of a rule without its parameters."""
    name = policy.partition(":")[0]
    return name if name in policy_names() else policy


def _label(policy: str) -> str:
    """Return what is compared: a saved agent, or a rule by its name."""
    if _rule(policy) not in policy_names("agent"):
        return _rule(policy)
    return "the calibrated agent" if "calibrated" in policy else "the agent"


def price_table(points: Sequence[Point], baselines: Mapping[str, EpisodeResults]) -> Table:
    """Return the table of the policy and the best baseline at each of its prices."""
    label = _label(points[0].policy)
    rows = []
    for point in points:
        price, best, cost, difference = point.at_price
        rates = f"{baselines[best].rate.mean():.4f}", f"{point.rate:.4f}"
        costs = f"{cost:.4f}", tables.difference(difference), tables.share(point.at_price.relative)
        rows.append((best, f"{price:.4g}", *rates, *costs))
    mean = tables.share(float(np.mean([point.at_price.relative for point in points])))
    rows.append((f"{label}, mean over prices", "", "", "", "", "", mean))
    own = f"{label.removeprefix('the ')}'s rate"
    heads = "price", "its rate", own, "its cost", "difference [95 %]", "relative"
    title = f"at equal price: cost = error + price · tokens, a step; negative: {label} is better"
    return tables.table_tables(title, ("best baseline", *heads), rows)


def rate_table(points: Sequence[Point]) -> Table:
    """Return the table of the policy and the envelope, at the policy's rate for each price."""
    label = _label(points[0].policy)
    rows = []
    for point in points:
        comparison = point.at_rate
        errors = f"{point.mse:.4f}", f"{comparison.envelope:.4f}{' *' * comparison.far_apart}"
        difference = comparison.difference
        share = tables.share(difference.mean / (comparison.envelope or np.nan))
        cells = f"{point.rate:.4f}", *errors, tables.difference(difference), share
        rows.append(("\n".join(comparison.between), *cells))
    heads = "rate", "its MSE", "envelope's MSE", "difference [95 %]", "relative"
    title = f"at equal rate: {label}, and the baselines' lower envelope at the same rate"
    far = any(point.at_rate.far_apart for point in points)
    note = f"* between baselines whose rates differ by more than {metrics.FAR_APART:g} times"
    return tables.table_tables(title, ("envelope between", *heads), rows, note if far else None)
