r"""Compare one policy with swept baselines: at its price, and at its rate.

    fusion-gym compare --config configs/biased_oscillator_ppo.yaml \
        --sweep configs/biased_sweep.yaml \
        --policy model:runs/biased_oscillator_ppo/best_model.zip --output runs/comparison

All policies run on the same seeds. An agent that observes the price of a token, or a rule with a
parameter ``price``, runs at ``--prices`` prices. At each price the table shows the agent and the
baseline of the least cost, where cost = error + price · tokens. At the agent's rate the table shows
its MSE and the MSE of the baselines' lower envelope.

The output folder contains ``evaluation.json`` (every policy), ``comparison.json`` (the comparison)
and ``pareto.png``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from fusion_gym.commands.command_line import Long
from fusion_gym.commands.evaluate import evaluation_report
from fusion_gym.commands.options import Episodes, OutputFolder, Seed, Whole
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import (
    FAR_APART,
    BaselineComparison,
    PriceComparison,
    compare_at_price,
    compare_with_envelope,
    lower_envelope,
)
from fusion_gym.evaluation.episodes import EpisodeResults, run_several
from fusion_gym.output import figures, tables
from fusion_gym.output.files import write
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.registry import make_policy, policy_names, policy_parameters
from fusion_gym.training.checked import load_checked
from fusion_gym.training.config import Experiment
from fusion_gym.training.diagnosis import warn_of_unused_tokens
from fusion_gym.training.sweeps import Sweep
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
    output: Annotated[Path, OutputFolder()]
    """Folder for the results."""
    episodes: Episodes = 1000
    """Episodes of each policy."""
    seed: Seed = 0
    """Seed of the first episode."""
    prices: Annotated[int | None, Whole(2, 1000)] = None
    """Run the policy at this many prices over the config's price_range."""

    keeps = False

    def run(self) -> None:
        """Run all policies on the same seeds, and write, print and draw the comparison."""
        world = load_checked(Experiment, self.config).environment
        sweep = load_checked(Sweep, self.sweep, "sweep")
        task = make_task(world.id, **world.options)
        requested = self.policies_of(task)
        for policy in requested:
            make_policy(policy, task)
        writing(("evaluation, comparison and figure", self.output))
        rules = sweep.policies(task.reward.price)
        baselines = run_all(task, rules, self.episodes, self.seed, "baselines")
        compare(world.id, task, sweep, baselines, requested, self.seed, self.output)

    def policies_of(self, task: Task) -> dict[str, float]:
        """Return the policy, or the policy at each price, with the price of a token."""
        if self.prices is None:
            return {self.policy: float(task.reward.price.draw(np.array([0.5]))[0])}
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


def compare(
    env_id: str, task: Task, sweep: Sweep, baselines: dict[str, EpisodeResults],
    agents: Mapping[str, float], seed: int, folder: Path,
) -> None:  # fmt: skip
    """Run the agent on the baselines' episodes, and write, print and draw the comparison."""
    episodes = next(iter(baselines.values())).episodes
    learned = run_all(task, list(agents), episodes, seed, "agent")
    points = []
    for name, item in learned.items():
        means = float(item.rate.mean()), float(item.mse.mean())
        at_price = compare_at_price(item, baselines, agents[name])
        points.append(Point(name, *means, at_price, compare_with_envelope(item, baselines)))
    envelope = lower_envelope(baselines)
    report = evaluation_report(env_id, task, episodes, seed, baselines | learned)
    write(folder / "evaluation.json", report)
    write(folder / "comparison.json", {"points": [point.plain() for point in points]})
    best = (point.at_price.best for point in points)
    visible = dict.fromkeys([*sweep.points, *best, *(point.name for point in envelope), *learned])
    console = tables.console()
    title = f"{env_id}: single policies, the best of all {len(baselines)} baselines, and the agent"
    reports = {name: report["policies"][name] for name in visible}
    console.print(tables.evaluation_table(title, reports, report["quantiles"], {}))
    console.print(price_table(points, baselines))
    console.print(rate_table(points))
    warn_of_unused_tokens(task, float(next(iter(learned.values())).tokens.mean()))
    lines = [
        figures.FigureLine(curve.label, [baselines[name] for name in rules])
        for curve in sweep.curves
        if (rules := curve.policies(task.reward.price))
    ]
    single = {name: baselines[name] for name in sweep.points}
    agent = figures.FigureLine(_label(list(agents)), list(learned.values()))
    figures.pareto(folder / "pareto.png", env_id, lines, single, agent, envelope)


@dataclass(frozen=True)
class Point:
    """The agent at one price: its rate per sensor and step, its MSE, and both comparisons."""

    agent: str
    rate: float
    mse: float
    at_price: PriceComparison
    at_rate: BaselineComparison

    def plain(self) -> dict[str, Any]:
        """Return the point as JSON."""
        result = asdict(self)
        for name in ("at_price", "at_rate"):
            comparison = getattr(self, name)
            result[name] = comparison._asdict() | {"difference": comparison.difference._asdict()}
        return result


def _label(agents: Sequence[str]) -> str:
    if len(agents) > 1:
        return f"the agent, at {len(agents)} prices"
    return "the agent" if agents[0].startswith("model:") else agents[0]


def price_table(points: Sequence[Point], baselines: Mapping[str, EpisodeResults]) -> Table:
    """Return the table of the agent and the best baseline at each of its prices."""
    rows = []
    for point in points:
        price, best, cost, difference = point.at_price
        row = (
            best,
            f"{price:.4g}",
            f"{baselines[best].rate.mean():.4f}",
            f"{point.rate:.4f}",
            f"{cost:.4f}",
            tables.difference(difference),
            f"{point.at_price.relative:+.1%}" if cost else "–",
        )
        rows.append(row)
    heads = "price", "its rate", "agent's rate", "its cost", "difference [95 %]", "relative"
    title = "at equal price: cost = error + price · tokens, a step; negative: the agent is better"
    return tables.table_tables(title, ("best baseline", *heads), rows)


def rate_table(points: Sequence[Point]) -> Table:
    """Return the table of the agent and the envelope, at the agent's rate for each price."""
    rows = []
    for point in points:
        comparison = point.at_rate
        share = comparison.difference.mean / (comparison.envelope or np.nan)
        row = (
            "\n".join(comparison.between),
            f"{point.rate:.4f}",
            f"{point.mse:.4f}",
            f"{comparison.envelope:.4f}" + (" *" if comparison.far_apart else ""),
            tables.difference(comparison.difference),
            # Without an error, as with a perfect channel, there is no share.
            "–" if np.isnan(share) else f"{share:+.1%}",
        )
        rows.append(row)
    heads = "rate", "agent's MSE", "envelope's MSE", "difference [95 %]", "relative"
    title = "at equal rate: the baselines' lower envelope at the agent's own rate"
    far = any(point.at_rate.far_apart for point in points)
    note = f"* between baselines whose rates differ by more than {FAR_APART:g} times"
    return tables.table_tables(title, ("envelope between", *heads), rows, note if far else None)
