"""Tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from fusion_gym.evaluation.intervals import Interval
from fusion_gym.evaluation.metrics import METRICS, Metric


def console() -> Console:
    """A console that keeps tables whole where the output is no terminal."""
    found = Console()
    return found if found.is_terminal else Console(width=150)


def number(interval: Mapping[str, float]) -> str:
    """Mean with the half width of its interval."""
    half = (interval["high"] - interval["low"]) / 2
    return f"{interval['mean']:.4g} ± {half:.2g}"


def difference(interval: Interval) -> str:
    """Mean and ends of an interval, with signs."""
    return f"{interval.mean:+.4f} [{interval.low:+.4f}, {interval.high:+.4f}]"


def evaluation_table(
    title: str,
    policies: Mapping[str, Mapping[str, Any]],
    quantiles: Mapping[str, Mapping[str, float]],
    differences: Mapping[str, Interval],
) -> Table:
    """One row a policy; ``differences`` to a reference may be empty."""
    table = Table(title=title, box=box.SIMPLE_HEAD, caption=_CAPTION)
    table.add_column("policy", overflow="fold")
    columns = {name: metric for name, metric in METRICS.items() if metric.column}
    for heading in [metric.column for metric in columns.values()] + ["median"]:
        table.add_column(heading, justify="right", no_wrap=True)
    if differences:
        table.add_column("MSE - reference", justify="right", no_wrap=True)
    for name, found in policies.items():
        row = [name, *(_cell(metric, found[key]) for key, metric in columns.items())]
        row.append(f"{quantiles[name]['median']:.4g}")
        if differences:
            row.append(difference(differences[name]) if name in differences else "reference")
        table.add_row(*row)
    return table


def _cell(metric: Metric, found: Any) -> str:
    """A metric's mean, over sensors where it has one for each, with its half width if shown."""
    if metric.interval:
        return number(found)
    return format(sum(found) / len(found) if metric.axis else found["mean"], metric.form)


def state_table(states: Sequence[str], policies: Mapping[str, Mapping[str, Any]]) -> Table:
    """Root mean square error of each state (and input, where there is one), a row a policy."""
    table = Table(
        title="root of the mean squared error over episodes, averaged over time",
        box=box.SIMPLE_HEAD,
    )
    table.add_column("policy", overflow="fold")
    for state in states:
        table.add_column(state, justify="right")
    for name, found in policies.items():
        table.add_row(name, *(f"{error:.4g}" for error in found["armse"]))
    return table


_CAPTION = (
    "mean ± half width of the 95 % bootstrap interval, and median of the MSE, over episodes; rate "
    "and requests per sensor and step, tokens and denied per step; NEES 1 is a consistent filter"
)
