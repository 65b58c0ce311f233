"""List the environments, rules, filters, signals, agents and configs of the library.

    fusion-gym list
    fusion-gym list environments rules

Without a kind it prints an overview, with kinds one line for each entry. ``fusion-gym info NAME``
shows the page of an entry.
"""

from dataclasses import dataclass
from textwrap import shorten
from typing import Annotated

import tyro
from rich import box
from rich.table import Table

from fusion_gym.commands.command_line import Command
from fusion_gym.output.tables import console
from fusion_gym.training.catalogue import CATALOGUE, Entry, catalogue
from fusion_gym.validation import keys


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
