"""Recordings of sensors: logs, their data cards, and plants fitted to them."""

from fusion_gym.importing import require

require("a recording", "recordings", "pandas", "statsmodels")

from fusion_gym.recordings.recording import ChannelCard, RecordedChannel, Recording  # noqa: E402

__all__ = ["ChannelCard", "RecordedChannel", "Recording"]
