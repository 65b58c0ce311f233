"""Films of frames that come one by one: GIF and MP4, by imageio."""

import contextlib
import importlib.util
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fusion_gym.envs.drawing import Frame
from fusion_gym.validation import ConfigurationError

from .files import replacing

ENDINGS = (".gif", ".mp4")


def checked_film(option: str, path: Path) -> None:
    """Whether a film can be written under this name.

    Raises:
        ConfigurationError: another ending, or what writes films is absent.
    """
    if path.suffix.lower() not in ENDINGS:
        raise ConfigurationError(
            f"{option} = {str(path)!r} is not allowed: it must end with {' or '.join(ENDINGS)}"
        )
    for package in ("imageio", "imageio_ffmpeg"):
        if importlib.util.find_spec(package) is None:
            raise ConfigurationError(
                f"{option} needs {package}, which is absent: pip install 'fusion-gym[render]'"
            )


def save_film(frames: Iterable[Frame], path: Path, fps: int) -> None:
    """Write the frames as they come; the file is there when the last has come, and whole.

    Heights and widths must be even, as the codec of MP4 wants them.
    """
    import imageio.v2 as imageio

    writer: Any
    settings: dict[str, Any]
    if path.suffix.lower() == ".gif":
        # 64 colours are plenty for lines; only what changes is written.
        settings = {"duration": 1000 / fps, "loop": 0, "palettesize": 64, "subrectangles": True}
    else:
        settings = {"fps": fps, "macro_block_size": 2}
    with (
        replacing(path) as unfinished,
        # Closed after an error too, which the writer's own context leaves to the collector.
        contextlib.closing(
            imageio.get_writer(unfinished, format=path.suffix[1:].upper(), **settings)
        ) as writer,
    ):
        for frame in frames:
            writer.append_data(frame)
