"""Tables for the terminal."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from fusion_gym.evaluation.metrics import METRICS, Interval, Metric


def console() -> Console:
    """Return a console for plain text, 150 columns wide if the output is no terminal."""
    result = Console(markup=False, emoji=False)
    return result if result.is_terminal else Console(markup=False, emoji=False, width=150)


def table_tables(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]] = (),
    caption: str | None = None,
) -> Table:
    """Return a table whose first column is folded text and whose others are numbers."""
    result = Table(title=title, box=box.SIMPLE_HEAD, caption=caption)
    result.add_column(columns[0], overflow="fold")
    for column in columns[1:]:
        result.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        result.add_row(*row)
    return result


def table_number(interval: Mapping[str, float]) -> str:
    """Return a mean with the half width of its interval, as text."""
    half = (interval["high"] - interval["low"]) / 2
    return f"{interval['mean']:.4g} ± {half:.2g}"


def difference(interval: Interval) -> str:
    """Return the mean and the ends of an interval with signs, as text."""
    return f"{interval.mean:+.4f} [{interval.low:+.4f}, {interval.high:+.4f}]"


def evaluation_table(
    title: str,
    policies: Mapping[str, Mapping[str, Any]],
    quantiles: Mapping[str, Mapping[str, float]],
    differences: Mapping[str, Interval],
) -> Table:
    """Return the table of an evaluation, with one row per policy."""
    common = set(METRICS).intersection(*policies.values())
    metrics = {name: item for name, item in METRICS.items() if item.column and name in common}
    columns = ["policy", *(metric.column for metric in metrics.values()), "median"]
    columns += ["MSE - reference"] if differences else []
    rows = []
    for name, policy in policies.items():
        row = [name, *(_cell(metric, policy[key]) for key, metric in metrics.items())]
        row.append(f"{quantiles[name]['median']:.4g}")
        if differences:
            row.append(difference(differences[name]) if name in differences else "reference")
        rows.append(row)
    return table_tables(title, columns, rows, _CAPTION)


def _cell(metric: Metric, value: Any) -> str:
    """Return a metric's mean, averaged over its axis, with its half width if shown."""
    if metric.interval:
        return table_number(value)
    return format(sum(value) / len(value) if metric.axis else value["mean"], metric.form)


def state_table(states: Sequence[str], policies: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the table of the root mean squared error of each state or input, a row per policy."""
    title = "root of the mean squared error over episodes, averaged over time"
    rows = ([name, *(f"{e:.4g}" for e in policy["armse"])] for name, policy in policies.items())
    return table_tables(title, ["policy", *states], rows)


_CAPTION = (
    "mean ± half width of the 95 % bootstrap interval, and median of the MSE, over episodes; rate "
    "and requests per sensor and step, tokens and denied per step; NEES 1 is a consistent filter"
)
