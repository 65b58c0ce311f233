r"""Watch one or two policies through an episode, in a window or as a film.

    fusion-gym watch --env fusion_gym/TobitOscillator-v1 --policy dynamic_event \
        --against innovation_threshold:threshold=1 --save episode.gif

Both policies meet the same noise. Their pictures stand side by side and share their axes: states
and fused estimates with two claimed deviations, requests with their answers, tokens.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fusion_gym.commands.command_line import EnvironmentOptions, Long
from fusion_gym.commands.options import OutputFile, Seed, whole
from fusion_gym.core.task import Task
from fusion_gym.envs.drawing import Frame, Window
from fusion_gym.envs.registration import make_task
from fusion_gym.errors import forbidden
from fusion_gym.evaluation.watching import watch
from fusion_gym.importing import require
from fusion_gym.output.films import ENDINGS, save_film
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.registry import make_policy


@dataclass(frozen=True)
class Watch(EnvironmentOptions, Long):
    """Watch one or two policies through an episode."""

    policy: Annotated[str, tyro.conf.arg(metavar="NAME[:key=value,…]")]
    """A rule or reference by name, zoo:NAME, model:PATH or module:Class."""
    against: Annotated[str | None, tyro.conf.arg(metavar="NAME[:key=value,…]")] = None
    """A second policy, on the same noise."""
    save: Annotated[Path | None, OutputFile(*ENDINGS)] = None
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
            self._show(frames, " against ".join(names))
        else:
            writing(("the film", self.save))
            save_film(self._counted(frames, task), self.save, self.fps)
            print(f"film in {self.save}")

    def interrupted(self) -> str:
        """Return the message after an interrupt, which leaves no film."""
        return "interrupted" if self.save is None else f"interrupted: no film in {self.save}"

    def _counted(self, frames: Iterator[Frame], task: Task) -> Iterator[Frame]:
        with progress_bar((self.steps or task.horizon) + 1, "filming") as bar:
            for frame in frames:
                yield frame
                bar.update()

    def _show(self, frames: Iterator[Frame], title: str) -> None:
        window = Window(title, self.fps)
        try:
            for frame in frames:
                window.show(frame)
        finally:
            window.close()
