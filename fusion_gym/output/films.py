"""Films of frames that come one by one: GIF and MP4, by imageio."""

import contextlib
import errno
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fusion_gym.envs.drawing import Frame
from fusion_gym.output.files import replacing

ENDINGS = (".gif", ".mp4")


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
    with replacing(path) as unfinished:
        # A GIF in memory, for its writer tries once more where the disk is full.
        goal: Any = io.BytesIO() if path.suffix.lower() == ".gif" else unfinished
        # Closed after an error too, which the writer's own context leaves to the collector.
        with contextlib.closing(
            imageio.get_writer(goal, format=path.suffix[1:].upper(), **settings)
        ) as writer:
            count = sum(writer.append_data(frame) is None for frame in frames)
        if goal is not unfinished:
            unfinished.write_bytes(goal.getvalue())
        elif not _complete(unfinished, count):
            raise OSError(errno.EIO, "the film is not complete, perhaps for want of room")


def _complete(film: Path, count: int) -> bool:
    """Whether a film has so many frames; its codec does not tell of a full disk."""
    from imageio_ffmpeg import count_frames_and_secs

    try:
        return bool(count_frames_and_secs(str(film))[0] == count)
    except RuntimeError:
        return False
