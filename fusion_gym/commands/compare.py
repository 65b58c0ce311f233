r"""Compare policies at equal communication: rules with one another, or one policy with baselines.

    fusion-gym compare --env fusion_gym/LinearFusion-v2 --output runs/rules \
        --policies innovation_threshold value_of_information periodic

Each rule runs over its first parameter, unless its text sets that. Two tables show the rules' MSE
at equal rates, and their costs, error + price · tokens, at equal prices: at those of the task's
price_range, or around its price. With ``--policy`` the rules are the baselines of one policy:

    fusion-gym compare --config configs/biased_oscillator_ppo.yaml \
        --sweep configs/biased_sweep.yaml \
        --policy model:runs/biased_oscillator_ppo/best_model.zip --output runs/comparison

An agent that observes the price of a token, or a rule with a parameter ``price``, runs at
``--prices`` prices. At each price a table shows the policy and the baseline of the least cost. At
the policy's rate a table shows its MSE and the MSE of the baselines' lower envelope.

All policies run on the same seeds. The output folder contains ``evaluation.json`` (every policy),
``comparison.json`` (the comparison) and ``pareto.png`` (the curves).
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

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
from fusion_gym.evaluation import curves, metrics
from fusion_gym.evaluation.episodes import EpisodeResults, run_several
from fusion_gym.output import figures, tables
from fusion_gym.output.files import write
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.registry import make_policy, policy_names, policy_parameters
from fusion_gym.training.config import Sweep, load_checked
from fusion_gym.training.run import warn_of_unused_tokens
from fusion_gym.validation import refusal

Texts = Mapping[str, Sequence[str]]  # the policies of each curve


@dataclass(frozen=True)
class Compare(EnvironmentOptions, Long):
    """Compare rules with one another, or one policy with baselines, at equal communication."""

    output: Annotated[Path, OUTPUT_FOLDER]
    """Folder for the results."""
    policies: PolicyNames = ()
    """The rules, or the baselines: names, texts, references or agents."""
    sweep: str | None = None
    """The baselines instead: a YAML file, or the name of a shipped sweep."""
    policy: str | None = None
    """A policy to compare with the baselines, for example model:PATH."""
    episodes: Episodes = 1000
    """Episodes of each policy."""
    seed: Seed = 0
    """Seed of the first episode."""
    prices: Annotated[int | None, whole(2, 1000)] = None
    """Run the policy at this many prices over the environment's price_range."""

    keeps = False

    def run(self) -> None:
        """Run all policies on the same seeds, and write, print and draw the comparison."""
        if self.policy is not None:
            self.points(self.policy)
            return
        if self.prices is not None:
            raise refusal("prices", self.prices, "left out without policy")
        env_id, options = self.environment()
        task = make_task(env_id, **options)
        texts = self.texts(task)
        writing(("evaluation, comparison and figure", self.output))
        every = list(dict.fromkeys(itertools.chain(*texts.values())))
        results = run_all(task, every, self.episodes, self.seed, "policies")
        report = evaluation_report(env_id, task, self.episodes, self.seed, results)
        rules = {label: {name: results[name] for name in own} for label, own in texts.items()}
        low, high = task.reward.price.span or curves.usual_prices(task, results)
        most = max(float(item.rate.mean()) for item in results.values())
        rates = {
            rate: {label: curves.error_at_rate(curve, rate) for label, curve in rules.items()}
            for rate in (most * np.array([0.1, 0.25, 0.5, 0.75])).tolist()
        }
        costs = {
            price: {label: curves.cost_at_price(curve, price) for label, curve in rules.items()}
            for price in np.geomspace(low, high, 5).tolist()
        }
        console, comparison = tables.console(), {}
        for title, word, samples in (
            ("MSE at equal rate (transmissions per sensor and step)", "rate", rates),
            ("cost at equal price: error + price · tokens, per step", "price", costs),
        ):
            compared = {place: curves.compare(own) for place, own in samples.items()}
            console.print(curve_table(f"{env_id}: {title}", word, compared))
            comparison[f"{word}s"] = [
                {word: place, "policies": {name: c and c.plain() for name, c in own.items()}}
                for place, own in compared.items()
            ]
        write(self.output / "evaluation.json", report)
        write(self.output / "comparison.json", comparison)
        lines = [figures.FigureLine(label, list(own.values())) for label, own in rules.items()]
        title = f"{_title(env_id, task)}: {self.episodes} episodes"
        figures.rules(self.output / "pareto.png", title, lines, (low, high))

    def points(self, policy: str) -> "list[Point]":
        """Compare a policy with the baselines, and return it at each price."""
        env_id, options = self.environment()
        task = make_task(env_id, **options)
        requested = self.policies_of(task, policy)
        for name in requested:
            make_policy(name, task)
        texts = self.texts(task)
        writing(("evaluation, comparison and figure", self.output))
        every, label = (
            dict.fromkeys(itertools.chain(*texts.values())),
            _label(next(iter(requested))),
        )
        baselines = run_all(task, list(every), self.episodes, self.seed, "baselines")
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
        report = evaluation_report(env_id, task, self.episodes, self.seed, baselines | results)
        write(self.output / "evaluation.json", report)
        write(self.output / "comparison.json", {"points": [point.plain() for point in points]})
        if label.endswith("agent"):
            warn_of_unused_tokens(task, float(next(iter(results.values())).tokens.mean()))
        best = dict.fromkeys(point.at_price.best for point in points)
        single = [own[0] for own in texts.values() if len(own) == 1]
        shown = dict.fromkeys([*single, *best, *results])
        reports = {name: report["policies"][name] for name in shown}
        title = f"single policies, the best of all {len(baselines)} baselines, and {label}"
        title, console = f"{env_id}: {title}", tables.console()
        console.print(tables.evaluation_table(title, reports, report["quantiles"], {}))
        console.print(rate_table(points))
        console.print(price_table(points, baselines))
        rules = ", ".join(sorted({_rule(name) for name in best}))
        least = [baselines[name] for name in best]
        lines = [
            figures.FigureLine(f"the best rule at each price: {rules}", least),
            *other_curves(texts, baselines, points),
            figures.FigureLine(label, list(results.values())),
        ]
        title = f"{_title(env_id, task)}: {label} against the best rule at the same price"
        costs = [point.at_price for point in points]
        figures.pareto(self.output / "pareto.png", title, lines, costs)
        return points

    def texts(self, task: Task) -> dict[str, list[str]]:
        """Return the policies of each curve of the baselines by its label."""
        names = list(dict.fromkeys(itertools.chain(*self.policies)))
        if bool(names) == (self.sweep is not None):
            raise refusal("policies", names, "given, or a sweep, and not both")
        if self.sweep is None:
            return {name: curves.sweep(task, name) for name in names}
        sweep = load_checked(Sweep, self.sweep, "sweep")
        each = {curve.label: curve.policies(task.reward.price) for curve in sweep.curves}
        return {text: [text] for text in sweep.points} | each

    def policies_of(self, task: Task, policy: str) -> dict[str, float]:
        """Return the policy, or the policy at each price, with the price of a token."""
        if self.prices is None:
            return {policy: task.reward.price.middle}
        span = task.reward.price.span
        if span is None:
            reason = "left out, because the environment has no price_range"
            raise refusal("prices", self.prices, reason)
        name, _, text = policy.partition(":")
        if name not in policy_names() or "price" not in policy_parameters(name):
            reason = f"left out with policy = {policy!r}, which takes no price"
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
    texts: Texts, baselines: Mapping[str, EpisodeResults], points: Sequence["Point"]
) -> list[figures.FigureLine]:
    """Return the best curve of each rule, for three rules that are the best at no price."""
    middle = points[len(points) // 2].at_price.price

    def cost(label: str) -> float:
        return min(float(baselines[name].cost(middle).mean()) for name in texts[label])

    best = {_rule(point.at_price.best) for point in points}
    others: dict[str, str] = {}
    for label in sorted((label for label, own in texts.items() if len(own) > 1), key=cost):
        others.setdefault(_rule(texts[label][0]), label)
    return [
        figures.FigureLine(label, [baselines[name] for name in texts[label]])
        for rule, label in others.items()
        if rule not in best
    ][:3]


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


def _title(env_id: str, task: Task) -> str:
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", class_name(env_id)).capitalize()
    return f"{name}, {task.sensors} sensor{'s' * (task.sensors > 1)}"


def curve_table(
    title: str, head: str, compared: Mapping[float, Mapping[str, curves.Comparison | None]]
) -> Table:
    """Return the table of rules at each of several rates or prices."""
    heads = "policy", *(f"{head} {place:.3g}" for place in compared)
    labels = next(iter(compared.values()))
    rows = ([label, *(_cell(own, label) for own in compared.values())] for label in labels)
    return tables.table_tables(
        title,
        heads,
        rows,
        "below each mean: its paired difference to the least, with its 95 % half width",
    )


def _cell(own: Mapping[str, curves.Comparison | None], label: str) -> str:
    comparison = own[label]
    if comparison is None:
        return "–"
    mean, (difference, low, high) = comparison
    unit, half = (mean - difference) / 100.0, (high - low) / 2.0
    if difference == 0.0:
        text = "least"
    elif difference > 1000.0 * unit:
        text = "> +1000 %"
    else:
        text = f"{difference / unit:+.1f} ± {half / unit:.1f} %"
    return f"{mean:.4g}\n{text}"


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
