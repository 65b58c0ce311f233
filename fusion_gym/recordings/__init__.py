"""Recordings of sensors: logs, their data cards, and plants fitted to them."""

from fusion_gym.importing import require

require("a recording", "agents", "pandas", "statsmodels")

from fusion_gym.recordings.fitting import Criticism, FittedPlant, criticise, fit  # noqa: E402
from fusion_gym.recordings.recording import (  # noqa: E402
    ChannelCard,
    RecordedChannel,
    Recording,
)

__all__ = [
    "ChannelCard",
    "Criticism",
    "FittedPlant",
    "RecordedChannel",
    "Recording",
    "criticise",
    "fit",
]
