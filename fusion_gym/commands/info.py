"""Show the page of an environment, rule, filter, signal, agent or config, or a log's data card.

    fusion-gym info fusion_gym/LinearFusion-v2
    fusion-gym info value_of_information
    fusion-gym info mast

``fusion-gym list`` shows all names. The path of a CSV file, ``mast`` and ``tanks`` are logs. The
data card of a log has rates, gaps, saturation and faults of the channels.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fusion_gym.commands.command_line import Command, OutputFile
from fusion_gym.commands.fit import LogOptions
from fusion_gym.envs.registration import base_of
from fusion_gym.output.progress import writing
from fusion_gym.output.tables import console
from fusion_gym.validation import nearest, refusal


def spelling(name: str) -> str:
    """Return a name without prefix, version, ending, parameters, case and separators."""
    name = re.sub(r"^(fusion_gym/|zoo:|configs/)|(-v\d+|\.yaml|[:,].*)$", "", name)
    return re.sub(r"[\W_]|Env$", "", name).lower()


@dataclass(frozen=True)
class Info(LogOptions, Command):
    """Show the page of an environment, rule, filter, signal, agent or config, or a log's card."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """A name of fusion-gym list, or the CSV file of a log. An environment may be LinearFusion,
    linear_fusion or fusion_gym/LinearFusion-v2, a rule may have parameters, and module:id imports
    the module first."""
    picture: Annotated[Path | None, OutputFile(".png", ".pdf", ".svg")] = None
    """File for a picture of the log."""

    def run(self) -> None:
        """Print the page of every entry of this name, or the card of the log."""
        # Imported here, because the readers of LaTeX and Markdown take a tenth of a second to load.
        from fusion_gym.commands.list import catalogue
        from fusion_gym.output.plain_text import plain_text

        is_own = re.fullmatch(r"(?!zoo:)[\w.]+:[\w/-]+", self.name)
        name, registered = base_of(self.name) if is_own else (self.name, {})
        entries = catalogue()
        names = {spelling(entry): entry for named in entries.values() for entry in named}
        names |= {entry: entry for entry in names.values()}
        name = names.get(name) or names.get(spelling(name), name)
        is_log = name in ("mast", "tanks") or ".csv" in Path(name).suffixes
        if name not in names and (is_log or Path(name).is_file()):
            self.show_log()
            return
        picture = None if self.picture is None else str(self.picture)
        for option, value in {"picture": picture, **self.reading}.items():
            if value:
                raise refusal(option, value, "left out with a name that is no log")
        if name not in names:
            close = nearest(name, names.values())
            hint = f"; did you mean {close!r}?" if close else ""
            raise refusal("name", name, f"a CSV file or a name of fusion-gym list{hint}")
        for kind, named in entries.items():
            if name in named:
                print(plain_text(f"# {name} ({kind})\n\n{named[name].page()}", console()))
        if registered:
            print(f"{self.name} is {name} with {registered}")

    def show_log(self) -> None:
        """Print the data card of a log, and draw its readings if there is a file for them."""
        from fusion_gym.recordings import Recording, field_report

        recording = Recording.read(self.name, **self.reading)
        print("\n".join(field_report.card_lines(recording)))
        console().print(field_report.card_table(recording))
        if self.picture is not None:
            writing(("picture", self.picture))
            field_report.draw_card(recording, self.picture)
