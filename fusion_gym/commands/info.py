"""Show the page of an environment, rule, filter, signal, agent or config.

    fusion-gym info fusion_gym/LinearFusion-v2
    fusion-gym info value_of_information

``fusion-gym list`` shows all names.
"""

from dataclasses import dataclass
from typing import Annotated

import tyro

from fusion_gym.commands.command_line import Command
from fusion_gym.envs.registration import present_id
from fusion_gym.output.plain import plain_text
from fusion_gym.output.tables import console
from fusion_gym.training.catalogue import catalogue
from fusion_gym.validation import nearest, refusal


@dataclass(frozen=True)
class Info(Command):
    """Show the page of an environment, rule, filter, signal, agent or config."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """A name of fusion-gym list; an environment's name may omit fusion_gym/ and the version."""

    def run(self) -> None:
        """Print the page of every entry of this name."""
        entries = catalogue()
        name = present_id(self.name)
        names = [entry for named in entries.values() for entry in named]
        if name not in names:
            hint = f"; did you mean {nearest(name, names)!r}?" if nearest(name, names) else ""
            raise refusal("name", name, f"a name of fusion-gym list{hint}")
        for kind, named in entries.items():
            if name in named:
                print(plain_text(f"# {name} ({kind})\n\n{named[name].page()}", console()))
