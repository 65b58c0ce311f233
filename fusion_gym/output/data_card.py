"""The data card of a recording: tables for the terminal, and a picture."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.table import Table

from fusion_gym.output.figures import save_figure
from fusion_gym.output.palette import BLUE, VERMILLION
from fusion_gym.output.tables import table_tables
from fusion_gym.recordings import ChannelCard, Criticism, Recording

COLUMNS = (
    "channel", "readings", "missing", "every", "mean", "deviation", "resolution", "saturated",
    "stuck", "spikes", "agreement", "fault",
)  # fmt: skip
RATIOS = "packets a sensor and step", "real error", "plant's error", "ratio", "NEES"
CAPTION = (
    "every: steps between two readings · stuck: readings in long runs of one value · agreement: "
    "correlation with the median of the channels of its unit"
)


def card_table(recording: Recording) -> Table:
    """Return the table of the channels."""
    return table_tables("channels", COLUMNS, map(card_row, recording.card), CAPTION)


def criticism_rows(criticism: Sequence[Criticism]) -> list[tuple[str, ...]]:
    """Return the rows of ``RATIOS``."""
    return [
        (f"{r.rate:g}", f"{r.real:.4f}", f"{r.model:.4f}", f"{r.ratio:.2f}", f"{r.nees:.2f}")
        for r in criticism
    ]


def card_lines(recording: Recording) -> list[str]:
    """Return the lines about the whole recording."""
    index, (gaps, longest) = recording.values.index, recording.gaps
    return [
        f"from {index[0]} to {index[-1]}: {len(index):,} steps of {recording.interval}",
        f"gaps of all channels: {gaps}, the longest {longest}",
        *recording.remarks,
    ]


def draw_card(recording: Recording, path: Path) -> None:
    """Draw the readings of every channel, red where the channel saturates."""
    cards, values = recording.card, recording.values
    size = 10.0, 1.2 + 1.1 * len(cards)
    figure, panels = plt.subplots(len(cards), 1, figsize=size, sharex=True, squeeze=False)
    for panel, card in zip(panels[:, 0], cards, strict=True):
        channel, readings = card.channel, values[card.channel.name]
        edge = (readings <= channel.low) | (readings >= channel.high)
        panel.plot(values.index, readings.where(~edge), ".", ms=1, color=BLUE, rasterized=True)
        panel.plot(values.index, readings.where(edge), ".", ms=1, color=VERMILLION, rasterized=True)
        title = f"{channel.name} [{channel.unit}]" if channel.unit else channel.name
        panel.set_title(f"{title}: {card.fault}" if card.fault else title, loc="left")
    figure.tight_layout()
    save_figure(figure, path)


def card_row(card: ChannelCard) -> tuple[str, ...]:
    """Return the cells of a channel."""
    channel = card.channel
    limits = [f"{end:g}" for end in (channel.low, channel.high) if np.isfinite(end)]
    saturated = f"{card.saturated:.1%} at {' and '.join(limits)}" if limits else "–"
    return (
        f"{channel.name} [{channel.unit}]" if channel.unit else channel.name,
        f"{card.readings:,}", f"{card.missing:.1%}", f"{card.every:g}", f"{card.mean:.4g}",
        f"{card.deviation:.3g}", f"{card.resolution:.2g}", saturated, f"{card.stuck:.1%}",
        str(card.spikes), "–" if np.isnan(card.agreement) else f"{card.agreement:.3f}", card.fault,
    )  # fmt: skip
