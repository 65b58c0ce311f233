r"""Fit a plant to a log of sensors, and write the option file that ``system=`` takes.

    fusion-gym fit mast --exact --output mast.yaml
    fusion-gym evaluate --env fusion_gym/LinearFusion-v2 --set system=mast.yaml

Level and daily cycle of every channel are removed. The plant is a vector autoregression of the
rest, fitted to the first part. The table compares its errors with the real errors of the other
part, under a periodic schedule at five rates; errors are relative to a channel's variance.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
import yaml

from fusion_gym.commands.command_line import Command
from fusion_gym.commands.options import OutputFile, between
from fusion_gym.output.field_report import RATIOS, criticism_rows
from fusion_gym.output.files import write_text
from fusion_gym.output.progress import remark, writing
from fusion_gym.output.tables import console, table_tables
from fusion_gym.recordings import FittedPlant, Recording, fit
from fusion_gym.recordings.fitting import (
    criticise,
    deviations,
    noisy_channels,
    residual_correlations,
    warnings_of,
)
from fusion_gym.version import __version__


@dataclass(frozen=True)
class Fit(Command):
    """Fit a plant to a log of sensors, and write the option file that system= takes."""

    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The CSV file, or mast or tanks; fusion-gym info shows its data card."""
    output: Annotated[Path, OutputFile(".yaml", ".yml")] = Path("plant.yaml")
    """The option file."""
    channels: tuple[str, ...] = ()
    """Channels by name; by default all without a fault."""
    share: Annotated[float, between(0.0, 0.95)] = 0.5
    """Share of the log, from its start, for the fit."""
    exact: bool = False
    """The readings are the truth: fit no measurement noise."""

    def run(self) -> None:
        """Fit, criticise and write."""
        recording = Recording.read(self.log).select(self.channels)
        plant = fit(recording, self.share, self.exact)
        values, rows = deviations(recording, self.share)
        criticism = criticise(plant, values[rows:])
        title = f"{', '.join(plant.names)}: order {plant.order}, fitted to {rows:,} steps"
        console().print(table_tables(title, RATIOS, criticism_rows(criticism)))
        white = residual_correlations(plant, values[rows:])
        text = ", ".join(f"{name} {value:.2f} (lag {lag})" for name, lag, value in white)
        print(f"largest correlations of residuals in ten lags: {text}")
        warnings = warnings_of(plant, values[rows:], criticism)
        for line in (*recording.remarks, *plant.remarks, *warnings):
            remark(f"warning: {line}")
        if names := noisy_channels(plant):
            remark(f"measurement noise of {', '.join(names)}: their readings are no truth")
        writing(("option file", self.output))
        write_text(self.output, plant_text(plant, recording, self.log, rows))


def plant_text(plant: FittedPlant, recording: Recording, log: str, rows: int) -> str:
    """Return the option file of a plant that was fitted to the first rows of a log."""
    source = f"# {Path(log).name}, the first {rows:,} steps of {recording.interval}"
    units = "; ".join(f"{c.name} [{c.unit}]" for c in recording.channels)
    text = yaml.safe_dump(plant.options, sort_keys=False, default_flow_style=None)
    return f"{source}\n# {units}\n# fusion-gym {__version__}\n{text}"
