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

from fusion_gym.commands.command_line import Command, OutputFile
from fusion_gym.commands.log_options import FitOptions, warn
from fusion_gym.output.files import write_text
from fusion_gym.output.progress import writing
from fusion_gym.output.tables import console, table_tables
from fusion_gym.recordings import FittedPlant, Recording, fit, fitting
from fusion_gym.recordings.field_report import RATIOS, criticism_rows
from fusion_gym.version import __version__


@dataclass(frozen=True)
class Fit(FitOptions, Command):
    """Fit a plant to a log of sensors, and write the option file that system= takes."""

    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The CSV file, or mast or tanks; fusion-gym info shows its data card."""
    output: Annotated[Path, OutputFile(".yaml", ".yml")] = Path("plant.yaml")
    """The option file."""

    def run(self) -> None:
        """Fit, criticise and write."""
        recording = self.select(Recording.read(self.log, **self.reading))
        plant = fit(recording, self.share, self.exact)
        values, rows = fitting.deviations(recording, self.share)
        criticism = fitting.criticise(plant, values[rows:])
        title = f"{', '.join(plant.names)}: order {plant.order}, fitted to {rows:,} steps"
        console().print(table_tables(title, RATIOS, criticism_rows(criticism)))
        white = fitting.residual_correlations(plant, values[rows:])
        text = ", ".join(f"{name} {value:.2f} (lag {lag})" for name, lag, value in white)
        print(f"largest correlations of residuals in ten lags: {text}")
        warnings = fitting.warnings_of(plant, values[rows:], criticism)
        if names := fitting.noisy_channels(plant):
            warnings.append(f"measurement noise of {', '.join(names)}: readings are no truth")
        warn((*recording.remarks, *plant.remarks, *warnings))
        writing(("option file", self.output))
        write_text(self.output, plant_text(plant, recording, self.log, rows))


def plant_text(plant: FittedPlant, recording: Recording, log: str, rows: int) -> str:
    """Return the option file of a plant that was fitted to the first rows of a log."""
    source = f"# {Path(log).name}, the first {rows:,} steps of {recording.interval}"
    units = "; ".join(f"{c.name} [{c.unit}]" for c in recording.channels)
    text = yaml.safe_dump(plant.options, sort_keys=False, default_flow_style=None)
    return f"{source}\n# {units}\n# fusion-gym {__version__}\n{text}"
