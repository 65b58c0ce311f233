r"""Fit a plant to a log of sensors, and write the option file that ``system=`` takes.

    fusion-gym fit mast --exact --output mast.yaml
    fusion-gym evaluate --env fusion_gym/LinearFusion-v2 --policies always \
        --set system=mast.yaml

Level and daily cycle of every channel are removed. The plant is a vector autoregression of the
rest, fitted to the first part. The table compares its errors with the real errors of the other
part, under a periodic schedule at five rates; errors are relative to a channel's variance.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from fusion_gym.commands.command_line import Command, OutputFile, between
from fusion_gym.errors import refusal
from fusion_gym.output.files import write_text
from fusion_gym.output.progress import remark, writing
from fusion_gym.output.tables import console, table_tables
from fusion_gym.version import __version__

if TYPE_CHECKING:
    from fusion_gym.recordings import FittedPlant, Recording


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Options that say how the file of a log is read."""

    date_format: str | None = None
    """Format of the times, such as %d/%m/%Y %H:%M; by default all rows decide."""
    time_unit: Literal["s", "ms", "us", "ns", "min", "h", "d", "excel"] | None = None
    """Unit of numeric times; by default the header names it."""
    error_code: tuple[float, ...] = ()
    """Values that mean a missing reading, beside the recognised ones."""
    unit: tuple[str, ...] = ()
    """Units of channels as NAME=UNIT, in place of the units in the header."""

    @property
    def reading(self) -> Mapping[str, Any]:
        """Keyword arguments of ``Recording.read``."""
        for word in self.unit:
            if "=" not in word:
                raise refusal("unit", word, "NAME=UNIT, such as air=°C")
        units = dict(word.split("=", 1) for word in self.unit)
        return {"date_format": self.date_format, "time_unit": self.time_unit,
                "error_codes": self.error_code, "units": units}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FitOptions(LogOptions):
    """Options that say what a plant is fitted to."""

    channels: tuple[str, ...] = ()
    """Channels by name; by default all without a fault."""
    share: Annotated[float, between(0.0, 0.95)] = 0.5
    """Share of the log, from its start, for the fit."""
    exact: bool = False
    """The readings are the truth: fit no measurement noise."""
    on_change: bool = False
    """The log is recorded on change: a silent channel still has its last reading."""

    def select(self, whole: "Recording") -> "Recording":
        """Return the channels to fit."""
        chosen = whole.select(self.channels, self.share)
        return chosen.hold() if self.on_change else chosen


def warn(lines: Iterable[str]) -> None:
    """Print warnings of a log and its plant."""
    for line in lines:
        remark(f"warning: {line}")


@dataclass(frozen=True)
class Fit(FitOptions, Command):
    """Fit a plant to a log of sensors, and write the option file that system= takes."""

    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The CSV file, or mast or tanks; fusion-gym info shows its data card."""
    output: Annotated[Path, OutputFile(".yaml", ".yml")] = Path("plant.yaml")
    """The option file."""

    def run(self) -> None:
        """Fit, criticise and write."""
        # Imported here, because the command info takes the options above without a log.
        from fusion_gym.recordings import Recording, fit, fitting
        from fusion_gym.recordings.field_report import RATIOS, criticism_rows

        recording = self.select(Recording.read(self.log, **self.reading))
        plant = fit(recording, self.share, self.exact)
        values, rows = fitting.deviations(recording, self.share)
        criticism = fitting.criticise(plant, values[rows:])
        title = f"{', '.join(plant.names)}: order {plant.order}, fitted to {rows:,} steps"
        console().print(table_tables(title, RATIOS, criticism_rows(criticism)))
        white = fitting.residual_correlations(plant, values[rows:])
        text = ", ".join(f"{name} {value:.2f} (lag {lag})" for name, lag, value in white)
        print(f"largest correlations of residuals in ten lags: {text}")
        noise = zip(plant.names, plant.measurement_variance**0.5, strict=True)
        print(f"measurement noise: {', '.join(f'{name} {value:.3g}' for name, value in noise)}")
        warnings = fitting.warnings_of(plant, values[rows:], criticism)
        warn((*recording.remarks, *plant.remarks, *warnings))
        writing(("option file", self.output))
        write_text(self.output, plant_text(plant, recording, self.log, rows))


def plant_text(plant: "FittedPlant", recording: "Recording", log: str, rows: int) -> str:
    """Return the option file of a plant that was fitted to the first rows of a log."""
    import yaml

    source = f"# {Path(log).name}, the first {rows:,} steps of {recording.interval}"
    units = "; ".join(f"{c.name} [{c.unit}]" for c in recording.channels)
    text = yaml.safe_dump(plant.options, sort_keys=False, default_flow_style=None)
    return f"{source}\n# {units}\n# fusion-gym {__version__}\n{text}"
