"""Show the page of an environment, rule, filter, signal, agent or config, or a log's data card.

    fusion-gym info fusion_gym/LinearFusion-v2
    fusion-gym info value_of_information
    fusion-gym info mast

``fusion-gym list`` shows all names. The path of a CSV file, ``mast`` and ``tanks`` are logs. The
data card of a log has rates, gaps, saturation and faults of the channels.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fusion_gym.commands.command_line import Command
from fusion_gym.commands.options import OutputFile
from fusion_gym.envs.registration import present_id
from fusion_gym.output.plain import plain_text
from fusion_gym.output.progress import writing
from fusion_gym.output.tables import console
from fusion_gym.training.catalogue import catalogue
from fusion_gym.validation import nearest, refusal


@dataclass(frozen=True)
class Info(Command):
    """Show the page of an environment, rule, filter, signal, agent or config, or a log's card."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """A name of fusion-gym list, or the CSV file of a log; an environment's name may omit
    fusion_gym/ and the version."""
    picture: Annotated[Path | None, OutputFile(".png", ".pdf", ".svg")] = None
    """File for a picture of the log."""

    def run(self) -> None:
        """Print the page of every entry of this name, or the card of the log."""
        entries = catalogue()
        name = present_id(self.name)
        names = [entry for named in entries.values() for entry in named]
        is_log = name in ("mast", "tanks") or ".csv" in Path(name).suffixes
        if name not in names and (is_log or Path(name).is_file()):
            self._show_log()
            return
        if self.picture is not None:
            raise refusal("picture", str(self.picture), "left out with a name that is no log")
        if name not in names:
            hint = f"; did you mean {nearest(name, names)!r}?" if nearest(name, names) else ""
            raise refusal("name", name, f"a CSV file or a name of fusion-gym list{hint}")
        for kind, named in entries.items():
            if name in named:
                print(plain_text(f"# {name} ({kind})\n\n{named[name].page()}", console()))

    def _show_log(self) -> None:
        from fusion_gym.output.data_card import card_lines, card_table, draw_card
        from fusion_gym.recordings import Recording

        recording = Recording.read(self.name)
        print("\n".join(card_lines(recording)))
        console().print(card_table(recording))
        if self.picture is not None:
            writing(("picture", self.picture))
            draw_card(recording, self.picture)
