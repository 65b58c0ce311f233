r"""Watch one or two policies through an episode, in a window or as a film.

    fusion-gym watch --env fusion_gym/TobitOscillator-v1 --save episode.gif \
        --policy dynamic_event --against innovation_threshold:threshold=1

Both policies meet the same noise. Their pictures stand side by side and share their axes: states
and fused estimates with two estimated deviations, requests with their answers, tokens.
"""

import contextlib
import errno
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from fusion_gym.commands.command_line import EnvironmentOptions, Long, OutputFile, Seed, whole
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments
from fusion_gym.envs.drawing import Frame, Window
from fusion_gym.envs.registration import make_task
from fusion_gym.errors import forbidden
from fusion_gym.evaluation.episodes import watch
from fusion_gym.importing import require
from fusion_gym.output.files import replacing
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.registry import make_policy


@dataclass(frozen=True)
class Watch(EnvironmentOptions, Long):
    """Watch one or two policies through an episode."""

    policy: Annotated[str, tyro.conf.arg(metavar="NAME[:key=value,…]")]
    """A rule or reference by name, zoo:NAME, model:PATH or module:Class."""
    against: Annotated[str | None, tyro.conf.arg(metavar="NAME[:key=value,…]")] = None
    """A second policy, on the same noise."""
    save: Annotated[Path | None, OutputFile(".gif", ".mp4")] = None
    """Write a film, .gif or .mp4, instead of showing a window."""
    seed: Seed = 0
    """Seed of the episode."""
    steps: Annotated[int | None, whole(1)] = None
    """Number of steps; the whole episode by default."""
    fps: Annotated[int, whole(1, 50)] = 10
    """Steps per second."""

    def run(self) -> None:
        """Show or save the episode."""
        if self.save is not None:
            require("save", "render", "imageio", "imageio_ffmpeg")
        env_id, options = self.environment()
        task = make_task(env_id, **options)
        names = [self.policy] if self.against is None else [self.policy, self.against]
        if len(set(names)) < len(names):
            raise forbidden("against", self.against, "it must differ from policy")
        policies = {name: make_policy(name, task) for name in names}
        frames = watch(task, policies, self.seed, self.steps)
        if self.save is None:
            with contextlib.closing(Window(" against ".join(names), self.fps)) as window:
                for frame in frames:
                    window.show(frame)
        else:
            writing(("the film", self.save))
            save_film(self._counted(frames, task), self.save, self.fps)
            print(f"film in {self.save}")

    def interrupted(self) -> str:
        """Return the message after an interrupt, which leaves no film."""
        return "interrupted" if self.save is None else f"interrupted: no film in {self.save}"

    def _counted(self, frames: Iterator[Frame], task: Task) -> Iterator[Frame]:
        with progress_bar(self.steps or task.horizon, "filming") as bar:
            for frame in frames:
                yield frame
                bar.update()


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
