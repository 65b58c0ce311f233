"""List the environments, rules, filters, signals, agents and configs of the library.

    fusion-gym list
    fusion-gym list environments rules

Without a kind it prints an overview, with kinds one line for each entry. ``fusion-gym info NAME``
shows the page of an entry.
"""

import itertools
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from textwrap import shorten
from typing import Annotated, Any, NamedTuple

import tyro
from rich import box
from rich.table import Table

from fusion_gym import zoo
from fusion_gym.commands.command_line import Command
from fusion_gym.core import code_cache
from fusion_gym.core.knowledge import MEANING, Signal
from fusion_gym.docstrings import plain_marks, read, table
from fusion_gym.envs.option_text import short
from fusion_gym.envs.pages import page
from fusion_gym.envs.registration import ENVIRONMENTS, build_of, make_task, options_of
from fusion_gym.evaluation.metrics import METRICS
from fusion_gym.fusion.table import RULES
from fusion_gym.output.tables import console
from fusion_gym.policies.registry import policy_maker, policy_names
from fusion_gym.validation import keys


class Entry(NamedTuple):
    """An entry: its meaning in one line, and a function that returns its page in Markdown."""

    meaning: str
    page: Callable[[], str]


# The entries of each kind by name, including the user's registrations.
CATALOGUE: dict[str, Callable[[], dict[str, Entry]]] = {
    "environments": lambda: {
        env_id: Entry(read(options_of(env_id)).summary, partial(_environment, env_id))
        for env_id in ENVIRONMENTS
    },
    "rules": lambda: {name: _declared(policy_maker(name)) for name in policy_names("rule")},
    "references": lambda: {
        name: _declared(policy_maker(name)) for name in policy_names("reference")
    },
    "filters": lambda: _filters(),
    "fusion": lambda: {n: _declared(type(row.make()), row.meaning) for n, row in RULES.items()},
    "signals": lambda: _signals(),
    "metrics": lambda: {
        name: Entry(row.meaning, partial(str, row.meaning)) for name, row in METRICS.items()
    },
    "algorithms": lambda: _algorithms(),
    "zoo": lambda: {name: _agent(name) for name in zoo.names()},
    "configs": lambda: _configs(),
}


def catalogue(*kinds: str) -> dict[str, dict[str, Entry]]:
    """Return the entries of some kinds, by default of all."""
    return {kind: CATALOGUE[kind]() for kind in kinds or CATALOGUE}


def _declared(owner: Any, meaning: str = "") -> Entry:
    """Return the entry of a docstring."""
    return Entry(plain_marks(meaning or read(owner).summary), partial(_page, owner, meaning))


def _page(owner: Any, meaning: str) -> str:
    """Return a docstring in Markdown, with a heading for each of its labels."""
    text, labelled = declared = read(owner)
    arguments = "\n".join(f"- `{name}`: {what}" for name, what in declared.arguments.items())
    parts = {"Parameters": arguments, **labelled, "Args": ""}
    below = [f"## {label}\n\n{part}" for label, part in parts.items() if part]
    return "\n\n".join([meaning, text, *below])


def _environment(env_id: str) -> str:
    rows = [(f"`{s.name}`", s.axes, s.knowledge, s.meaning) for s in _signals_of(env_id)]
    head = ("signal", "axes", "known to", "meaning")
    return f"{page(env_id)}\n## Signals\n{table(head, rows)}\n"


def _filters() -> dict[str, Entry]:
    """Return the filters of all environments; a name may belong to several classes."""
    owners: dict[str, dict[type, list[str]]] = {}
    for env_id in ENVIRONMENTS:
        for name, owner in options_of(env_id).filters.items():
            owners.setdefault(name or owner.__name__, {}).setdefault(owner, []).append(env_id)
    return {
        name: Entry("; ".join(_declared(o).meaning for o in places), partial(_classes, places))
        for name, places in owners.items()
    }


def _classes(places: Mapping[type, list[str]]) -> str:
    """Return the declarations of classes, each below the environments of the class."""
    return "\n\n".join(
        f"# {', '.join(where)}\n\n{_declared(owner).page()}" for owner, where in places.items()
    )


def _signals_of(env_id: str) -> Sequence[Signal]:
    """Return the signals of an environment, whose task may take a second to make."""

    def declared() -> Sequence[Signal]:
        return make_task(env_id).estimator.signals

    return code_cache.stored("signals", (env_id, build_of(env_id)), declared)


def _signals() -> dict[str, Entry]:
    """Return the signals of all environments, each with its environments."""
    rows: dict[str, list[tuple[str, ...]]] = {}
    for env_id in ENVIRONMENTS:
        for signal in _signals_of(env_id):
            known, place = MEANING[signal.knowledge], env_id.rpartition("/")[2]
            row = (place, signal.axes, known, signal.meaning)
            rows.setdefault(signal.name, []).append(row)
    head = ("environment", "axes", "known to", "meaning")
    return {name: Entry(where[0][-1], partial(table, head, where)) for name, where in rows.items()}


def _algorithms() -> dict[str, Entry]:
    # Imported here, because pydantic takes a tenth of a second to load.
    from fusion_gym.training.config import TABLE

    return {name: Entry(row.meaning, partial(_settings, name, row)) for name, row in TABLE.items()}


def _settings(name: str, row: Any) -> str:
    """Return the settings of an algorithm with their defaults."""
    fields = row.config(name=name).model_dump(exclude={"name"})
    rows = [(f"`{name}`", short(value)) for name, value in fields.items()]
    return f"{row.meaning}; {row.source}\n\n{table(('setting', 'default'), rows)}\n"


def _agent(name: str) -> Entry:
    card = zoo.card(name)
    options = " ".join(f"{key}={value}" for key, value in card["options"].items())
    points = zip(card["test"]["prices"], card["test"]["points"], strict=True)
    names = ("cost", "mse", "tokens")
    rows = [(f"{p:.3g}", *(f"{point[name]:.4g}" for name in names)) for p, point in points]
    where, head = f"{card['env']} {options}", ("price of a token", "cost", "MSE", "tokens per step")
    return Entry(where, lambda: f"{where}\n\n{table(head, rows)}\n")


def _configs() -> dict[str, Entry]:
    from fusion_gym.training.config import SHIPPED

    return {path.stem: _config(path.read_text("utf-8")) for path in sorted(SHIPPED.glob("*.yaml"))}


def _config(text: str) -> Entry:
    """Return a config with the first sentence of its comment."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = " ".join(line.strip("# ") for line in lines)
    return Entry(re.split(r"(?<=[.])\s", comment)[0], partial(textwrap.indent, text, "    "))


@dataclass(frozen=True)
class List(Command):
    """List the environments, rules, filters, signals, agents and configs of the library."""

    kinds: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="KIND")] = ()
    """Kinds to list, such as environments or rules; the overview by default."""

    def run(self) -> None:
        """Print a table of each kind, or the environments and the names of all other kinds."""
        keys("kind", self.kinds, CATALOGUE)
        tables = entries = catalogue(*self.kinds)
        if not self.kinds:
            lines = {kind: ", ".join(entries.pop(kind)) for kind in [*entries][1:]}
            names = {k: Entry(shorten(v, 270, placeholder=" …"), str) for k, v in lines.items()}
            tables = entries | {"fusion-gym list KIND": names}
        for title, rows in tables.items():
            result = Table(title=title, title_justify="left", box=box.SIMPLE, show_header=False)
            result.add_column(no_wrap=True)
            result.add_column(overflow="fold")
            for name, entry in rows.items():
                result.add_row(name, entry.meaning)
            console().print(result, markup=False)
