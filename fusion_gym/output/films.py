"""Write films as GIF or MP4, by imageio."""

import contextlib
import errno
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fusion_gym.entries import Arguments
from fusion_gym.envs.drawing import Frame
from fusion_gym.output.files import replacing

ENDINGS = (".gif", ".mp4")


def save_film(frames: Iterable[Frame], path: Path, fps: int) -> None:
    """Write frames of even height and width as a film; the file appears after the last frame."""
    import imageio.v2 as imageio

    writer: Any
    gif = path.suffix.lower() in ("", ".gif")
    settings: Arguments = {"fps": fps, "macro_block_size": 2}
    if gif:  # 64 colours suffice for lines; only changed pixels are written
        settings = {"duration": 1000 / fps, "loop": 0, "palettesize": 64, "subrectangles": True}
    with replacing(path) as unfinished:
        # A GIF in memory, because its writer tries again on a full disk.
        goal: Any = io.BytesIO() if gif else unfinished
        # Closed after an error too, unlike by the writer's own context.
        with contextlib.closing(
            imageio.get_writer(goal, format=path.suffix[1:].upper() or "GIF", **settings)
        ) as writer:
            count = sum(writer.append_data(frame) is None for frame in frames)
        if gif:
            unfinished.write_bytes(goal.getvalue())
        elif not _complete(unfinished, count):
            raise OSError(errno.EIO, "the film is not complete; the disk may be full")


def _complete(film: Path, count: int) -> bool:
    """Return whether a film has so many frames; its codec does not report a full disk."""
    from imageio_ffmpeg import count_frames_and_secs

    try:
        return bool(count_frames_and_secs(str(film))[0] == count)
    except RuntimeError:
        return False
