"""Options of commands that read a log, and fit a plant to it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fusion_gym.commands.command_line import between
from fusion_gym.output.progress import remark, writing
from fusion_gym.output.tables import console

if TYPE_CHECKING:
    from fusion_gym.recordings import Recording


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Options that say how the file of a log is read."""

    date_format: str | None = None
    """Format of the times, such as %d/%m/%Y %H:%M; by default all rows decide."""
    time_unit: Literal["s", "ms", "us", "ns", "min", "h", "d", "excel"] | None = None
    """Unit of numeric times; by default their head names it."""
    error_code: tuple[float, ...] = ()
    """Values that are no readings, beside the recognised ones."""

    @property
    def reading(self) -> Mapping[str, Any]:
        """Keyword arguments of ``Recording.read``."""
        return {"date_format": self.date_format, "time_unit": self.time_unit,
                "error_codes": self.error_code}  # fmt: skip

    def show(self, log: str, picture: Path | None) -> None:
        """Print the data card of a log, and draw its readings if there is a file for them."""
        from fusion_gym.recordings import Recording, field_report

        recording = Recording.read(log, **self.reading)
        print("\n".join(field_report.card_lines(recording)))
        console().print(field_report.card_table(recording))
        if picture is not None:
            writing(("picture", picture))
            field_report.draw_card(recording, picture)


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
