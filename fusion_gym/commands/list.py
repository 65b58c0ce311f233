"""List what the suite has: environments, rules, filters, signals, agents, configs.

    fusion-gym list
    fusion-gym list environments rules

``fusion-gym info NAME`` shows the page of an entry.
"""

from dataclasses import dataclass
from typing import Annotated

import tyro
from rich import box
from rich.table import Table

from fusion_gym.commands.command_line import Command
from fusion_gym.output.tables import console
from fusion_gym.training.catalogue import catalogue
from fusion_gym.validation import keys


@dataclass(frozen=True)
class List(Command):
    """List what the suite has."""

    kinds: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="KIND")] = ()
    """Kinds to list, such as environments or rules; none stands for all."""

    def run(self) -> None:
        """Print a table of each kind.

        Raises:
            ConfigurationError: an unknown kind; the message lists all.
        """
        entries = catalogue()
        keys("kind", self.kinds, entries)
        for kind in self.kinds or entries:
            result = Table(title=kind, title_justify="left", box=box.SIMPLE_HEAD, show_header=False)
            result.add_column(no_wrap=True)
            result.add_column(overflow="fold")
            for name, entry in entries[kind].items():
                result.add_row(name, entry.meaning)
            console().print(result, markup=False)
