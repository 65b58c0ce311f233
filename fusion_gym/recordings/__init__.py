"""Logs of sensors: data cards, fitted plants, an environment, and the study of their reports."""

from typing import TYPE_CHECKING, Any, Literal

from fusion_gym.importing import require

if TYPE_CHECKING:
    from fusion_gym.recordings.card import ChannelCard, RecordedChannel
    from fusion_gym.recordings.fitting import Criticism, FittedPlant, criticise, fit
    from fusion_gym.recordings.recording import Recording

DeviceName = Literal["zigbee", "bacnet", "esphome"]

__all__ = [
    "ChannelCard",
    "Criticism",
    "FittedPlant",
    "RecordedChannel",
    "Recording",
    "criticise",
    "fit",
]

if not TYPE_CHECKING:  # type checkers see only the names above

    def __getattr__(name: str) -> Any:
        """Import a name on first access: the environment's options need no pandas."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        require("a recording", "agents", "pandas", "statsmodels")
        from fusion_gym.recordings import fitting, recording

        return getattr(recording, name, None) or getattr(fitting, name)
