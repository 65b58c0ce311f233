"""Pictures of a running episode: states and estimates, requests and packets, tokens."""

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.runs import Outcome
from fusion_gym.core.task import Task
from fusion_gym.importing import require

Frame = NDArray[np.uint8]  # (height, width, 3)
WINDOW = 60  # steps in a picture, at most
_MOST_STATES = 4
# Okabe and Ito's palette for colour-blind readers.
_TRUTH, _ESTIMATE, _GRANTED, _DENIED, _TOKENS = "black", "#D55E00", "#0072B2", "0.55", "#009E73"
_CENSORED, _LOST, _LATE = "#CC79A7", "black", "#E69F00"
_WIDTH, _STATE, _STRIP, _TOP, _BOTTOM = 640, 120, 70, 62, 44  # pixels


class _Step(NamedTuple):
    """The drawn arrays of one step of all runs, shared without copies."""

    state: Any
    outcome: Outcome
    tokens: Array


class Film:
    """The last steps of N runs of a task, and a picture of each run.

    A picture shows up to four states with the fused estimate and two estimated standard deviations,
    one row of requests per sensor (granted or denied; if the network can lose or delay packets,
    also lost or late, with a line to the arrival), the input of a controller, and the tokens if
    they are limited. The censored range of a state is shaded. A plant's own picture stands beside
    it.

    Args:
        task: The task.
        runs: Number N of runs.
        steps: Number of steps of the film; the horizon by default.

    Raises:
        ConfigurationError: matplotlib is absent.
    """

    def __init__(self, task: Task, runs: int, steps: int | None = None) -> None:
        require("render_mode", "render", "matplotlib")
        self.task = task
        self._window = min(task.horizon if steps is None else steps, WINDOW)
        self._steps: deque[_Step] = deque(maxlen=self._window)
        self._ages = np.zeros(runs, dtype=np.int64)  # steps of each run's episode
        self._state_names = task.plant.state_names[:_MOST_STATES]
        self._figure: Any = None  # created by the first frame
        self._plant: Any = None  # the plant's present state

    def begin(self, batch: EpisodeBatch, runs: NDArray[np.int64] | None = None) -> None:
        """Begin a new episode in ``runs``, by default in all."""
        self._plant = batch.state.plant
        self._ages[slice(None) if runs is None else runs] = 0

    def record(self, batch: EpisodeBatch, outcome: Outcome) -> None:
        """Record a step of all runs, before a reset."""
        self._plant = batch.state.plant
        self._steps.append(_Step(batch.delivered, outcome, batch.tokens))
        self._ages += 1

    def limits(self, run: int = 0) -> list[tuple[float, float]]:
        """Return the axis limits of each drawn state, for films side by side."""
        truth, mean, deviation = self._series(self._recent_steps(run), run)
        if not len(truth):
            return [(-1.0, 1.0)] * len(self._state_names)
        low, high = np.minimum(truth, mean).min(0), np.maximum(truth, mean).max(0)
        room = 0.15 * (high - low) + 1e-6 + 0.5 * np.median(deviation, 0)
        return list(zip((low - room).tolist(), (high + room).tolist(), strict=True))

    def frame(
        self,
        run: int = 0,
        title: str | None = None,
        limits: Sequence[tuple[float, float]] | None = None,
        truth: Array | None = None,
    ) -> Frame:
        """Return the picture of a run's present episode, by default with the step as title.

        ``truth`` (steps, shown) are the states of the whole film, drawn faintly.
        """
        if self._figure is None:
            self._draw_frame()
        age, steps = int(self._ages[run]), self._recent_steps(run)
        times = np.arange(age - len(steps) + 1, age + 1)
        first = max(age - self._window, 0)
        self._title.set_text(f"step {age} of {self.task.horizon}" if title is None else title)
        state, mean, deviation = self._series(steps, run)
        ranges = self.limits(run) if limits is None else limits
        for place, (axis, lines, ends) in enumerate(
            zip(self._axes, self._curves, ranges, strict=False)
        ):
            centre, wide = mean[:, place], deviation[:, place]
            lines[0].set_data(times, state[:, place])
            lines[1].set_data(times, centre)
            lines[2].remove()
            lines[2] = axis.fill_between(
                times, centre - wide, centre + wide, color=_ESTIMATE, alpha=0.18, lw=0
            )
            axis.set_ylim(*ends)
            if truth is not None:
                lines[3].set_data(np.arange(len(truth)) + 1, truth[:, place])
        packets = np.array([_packets(step, run) for step in steps], dtype=np.int64)
        *drawn, late = packets.reshape(-1, 4, self.task.sensors).swapaxes(0, 1)
        for mark, marked in zip(self._marks, drawn, strict=False):
            places, sensors = np.nonzero(marked)
            mark.set_data(times[places], sensors)
        if self._late is not None:
            places, sensors = np.nonzero(late)
            sent, arrival = times[places], times[places] + late[places, sensors]
            gap = np.full(len(sent), np.nan)  # between two packets
            across = sent, np.where(arrival <= age, arrival, gap), gap
            down = sensors, sensors - 0.3, gap
            self._late.set_data(np.stack(across, 1).ravel(), np.stack(down, 1).ravel())
        for place, line in enumerate(self._inputs):
            line.set_data(times, [cast(Array, s.outcome.control)[place, run] for s in steps])
        if self._inputs:
            inputs: Any = [value for line in self._inputs for value in line.get_ydata()]
            low, high = min(inputs, default=0.0), max(inputs, default=0.0)
            margin = 0.1 * (high - low) + 1e-3
            self._inputs[0].axes.set_ylim(low - margin, high + margin)
        if self._level is not None:
            self._level.set_data(times, [step.tokens[run] for step in steps])
        self._axes[-1].set_xlim(first, first + self._window + 1)
        self._canvas.draw()
        curves: Frame = np.asarray(self._canvas.buffer_rgba(), np.uint8)[..., :3].copy()
        picture = self.task.picture
        own = None if picture is None else picture(self._plant, run)
        return curves if own is None else _join(curves, own)

    def truth(self, run: int = 0) -> Array:
        """Return the drawn states (shown,) of a run after its last step."""
        return self._series(self._recent_steps(run)[-1:], run)[0][0]

    def _recent_steps(self, run: int) -> list[_Step]:
        """Return the recorded steps of this run's episode in the window."""
        age = int(self._ages[run])
        return list(self._steps)[-min(age, self._window) :] if age else []

    def _series(self, steps: list[_Step], run: int) -> tuple[Array, Array, Array]:
        """Return truth, fused estimate and two estimated deviations, each (steps, shown)."""
        plant, estimator, visible = self.task.plant, self.task.estimator, len(self._state_names)
        estimates = [step.state.estimate for step in steps]
        fused = [(estimator.mean(own), estimator.covariance(own)) for own in estimates]
        truth = np.array([plant.truth(step.state.plant)[:visible, run] for step in steps])
        mean = np.array([value[0][:visible, run] for value in fused])
        variance = np.array([linalg.diagonal(value[1])[:visible, run] for value in fused])
        truth, mean, variance = (part.reshape(-1, visible) for part in (truth, mean, variance))
        return truth, mean, 2.0 * np.sqrt(np.maximum(variance, 0.0))

    def _draw_frame(self) -> None:
        """Draw the static parts of the picture."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        controller, states = self.task.controller, len(self.task.plant.state_names)
        strips = 2 - self.task.network.bucket.unlimited + (controller is not None)
        ratios = [_STATE] * len(self._state_names) + [_STRIP] * strips
        height = _TOP + _BOTTOM + sum(ratios)
        self._figure = Figure(figsize=(_WIDTH / 100, height / 100), dpi=100)
        self._canvas = FigureCanvasAgg(self._figure)
        self._axes: list[Any] = list(
            self._figure.subplots(
                len(ratios), 1, sharex=True,
                gridspec_kw={"height_ratios": ratios, "hspace": 0.12, "left": 0.1, "right": 0.98,
                             "bottom": _BOTTOM / height, "top": 1.0 - _TOP / height},
            )
        )  # fmt: skip
        self._curves: list[list[Any]] = []
        limits = self.task.plant.censored_beyond
        for place, (name, axis) in enumerate(zip(self._state_names, self._axes, strict=False)):
            (truth,) = axis.plot([], [], color=_TRUTH, lw=1.4, label="state")
            (mean,) = axis.plot([], [], color=_ESTIMATE, lw=1.4, label="fused estimate")
            band = axis.fill_between(
                [], [], [], color=_ESTIMATE, alpha=0.18, lw=0, label="± 2 estimated deviations"
            )
            for end, beyond in zip(limits.get(place, ()), (-1e9, 1e9), strict=False):
                if np.isfinite(end):
                    axis.axhspan(
                        *sorted((end, beyond)), color=_CENSORED, alpha=0.15, lw=0, label="censored"
                    )
            axis.set_ylabel(name)
            (whole,) = axis.plot([], [], color=_TRUTH, lw=1.0, alpha=0.3)
            self._curves.append([truth, mean, band, whole])
        sensors, bucket = self.task.sensors, self.task.network.bucket
        requests = self._axes[len(self._state_names)]
        channel, late = self.task.network.channel, self.task.delayed
        loses = self.task.network.rule.contended or (channel is not None and channel.loses)
        word = "arrived" if loses or late else "granted"
        self._marks = requests.plot([], [], "|", color=_GRANTED, ms=9, mew=2, label=word)
        self._marks += requests.plot([], [], "x", color=_DENIED, ms=5, label="denied")
        if loses:
            self._marks += requests.plot([], [], "v", color=_LOST, ms=5, label="lost")
        self._late: Any = None
        if late:
            (self._late,) = requests.plot([], [], ".-", color=_LATE, ms=5, lw=1, label="late")
        requests.set_ylim(sensors - 0.4, -0.6)
        requests.set_yticks(range(sensors) if sensors <= 6 else [0, sensors - 1])
        requests.set_ylabel("sensor")
        self._inputs: list[Any] = []
        if controller is not None:
            axis, still = self._axes[len(self._state_names) + 1], np.zeros((states, 1))
            axis.set_ylabel("input")
            self._inputs = [axis.plot([], [], lw=1.2)[0] for _ in controller.act(still)]
        self._level: Any = None
        if not bucket.unlimited:
            (self._level,) = self._axes[-1].plot([], [], color=_TOKENS, lw=1.6)
            self._axes[-1].set(ylim=(0.0, 1.08 * float(np.sum(bucket.capacity))), ylabel="tokens")
        self._axes[-1].set_xlabel("step")
        self._axes[-1].xaxis.get_major_locator().set_params(integer=True)
        for axis in self._axes:
            axis.tick_params(labelsize=8)
            axis.yaxis.set_label_coords(-0.065, 0.5)  # a fixed position is faster
            axis.grid(alpha=0.25)
            axis.spines[["top", "right"]].set_visible(False)
        handles: dict[str, Any] = {}
        for axis in self._axes:
            drawn, labels = axis.get_legend_handles_labels()
            handles = dict(zip(labels, drawn, strict=True)) | handles
        self._figure.legend(
            list(handles.values()), list(handles), loc="upper left", ncols=len(handles),
            bbox_to_anchor=(0.09, 1.0 - 37 / height), fontsize=7, frameon=False, borderaxespad=0.0,
            borderpad=0.2, columnspacing=1.2 if len(handles) < 8 else 0.6, handlelength=1.4,
        )  # fmt: skip
        self._title = self._figure.text(
            0.1, 1.0 - 4 / height, "", va="top", fontsize=9, parse_math=False
        )


def _packets(step: _Step, run: int) -> list[NDArray[Any]]:
    """Return the requests (sensors,) that arrive at once, are denied, or lost, and late delays."""
    requested, granted = step.outcome.requested[:, run], step.outcome.granted[:, run]
    arrived, due = step.outcome.age[:, run] == 0.0, step.state.network.due
    late = 0 * requested if due is None else due[0, :, run]
    return [arrived, requested & ~granted, granted & ~arrived & (late == 0), late]


def _join(*pictures: Frame) -> Frame:
    """Return pictures side by side, on white."""
    height = max(map(len, pictures))
    sizes = [((0, height - len(picture)), (0, 0), (0, 0)) for picture in pictures]
    padded = [np.pad(p, size, constant_values=255) for p, size in zip(pictures, sizes, strict=True)]
    return np.hstack(padded)


class Window:
    """A window that shows ``fps`` frames per second; it needs pygame."""

    def __init__(self, title: str, fps: int) -> None:
        require("render_mode", "render", "pygame")
        self._title, self._fps = title, fps
        self._screen: Any = None

    def show(self, frame: Frame) -> None:
        """Show one frame for 1/fps seconds."""
        import pygame

        if self._screen is None:
            pygame.init()
            self._screen = pygame.display.set_mode(frame.shape[1::-1])
            pygame.display.set_caption(self._title)
            self._clock = pygame.time.Clock()
        pygame.event.pump()
        self._screen.blit(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), (0, 0))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        if self._screen is not None:
            import pygame

            pygame.quit()
            self._screen = None
