"""The project's main job, end to end: two fronts learned in minutes, and a fair comparison.

    fusion-gym demo [--output runs/demo] [--episodes 1000] [--fresh]

In the Tobit oscillator's benchmark setting it trains an agent for a scheduler and one for sensors
by themselves, side by side; both see the price of a token. It runs them at seven prices, and on the
same test episodes the rules of the committed envelopes that know as much, without memory and with
it; and it draws the agents over the rules. What is finished in the output folder is not done again,
and an interrupted training is gone on with.
"""

import shutil
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from rich import box
from rich.table import Table

from fusion_gym.evaluation.envelope import points_of
from fusion_gym.evaluation.episodes import record_episode
from fusion_gym.evaluation.intervals import Interval
from fusion_gym.validation import ConfigurationError

from .command_line import Long
from .experiments.references import CommittedRules, Trials, at_least, envelope_task
from .experiments.workers import Pool, side_by_side, train_beside
from .input.options import Episodes, OutputFolder, Steps
from .output import figures, front_figure, tables
from .output.ending import ended_like_by_ctrl_c
from .output.files import write
from .output.folders import alone_in
from .output.progress import writing
from .training.checked import load_checked
from .training.config import Experiment
from .training.run import earlier, holds_training

SETTING = "tobit_oscillator"
TEAM = Pool(2)


class Learner(NamedTuple):
    """Who learns: the config that trains it, its title, and the classes of rules beside it.

    ``plain`` rules know what the agent does but what it remembers, ``with_memory`` ones exactly as
    much. ``bounded`` where the proven bound and the rollout are for: a scheduler.
    """

    name: str
    config: str
    title: str
    plain: str
    with_memory: str
    bounded: bool = False


LEARNERS = (
    Learner(
        name="scheduler",
        config="tobit_oscillator_front",
        title="A scheduler that sees all new measurements",
        plain="sensors",
        with_memory="sensors_memory",
        bounded=True,
    ),
    Learner(
        name="alone",
        config="tobit_oscillator_front_local",
        title="Sensors by themselves, which hear the centre's estimate",
        plain="local_estimate",
        with_memory="local_estimate_memory",
    ),
)


@dataclass(frozen=True)
class Demo(Long):
    """Two fronts learned in minutes, and a fair comparison with the strongest rules."""

    output: Annotated[Path, OutputFolder()] = Path("runs/demo")
    """Folder for the results."""
    episodes: Episodes = 1000
    """Test episodes of each agent at each price, and of each rule."""
    timesteps: Steps = 700_000
    """Steps of each training, fewer than its config's: the last per cent takes half the time."""
    fresh: bool = False
    """Remove earlier results first."""

    def run(self) -> None:
        """From trainings to figures."""
        ground = CommittedRules.read(SETTING, self.episodes)
        folders = {learner.name: self.output / learner.name for learner in LEARNERS}
        experiments = {
            learner.name: load_checked(Experiment, learner.config).changed(
                folders[learner.name] / "agent", timesteps=self.timesteps
            )
            for learner in LEARNERS
        }
        if self.fresh:
            remove(folders.values(), only_check=True)
        for item in () if self.fresh else experiments.values():
            earlier(item, Path(item.output), holds_training(Path(item.output)))
        with ended_like_by_ctrl_c(), alone_in(self.output, "output"):
            if self.fresh:
                remove(folders.values())
            writing(("models, figures and tables", self.output))
            began = time.perf_counter()
            train_beside(experiments)
            trained = time.perf_counter()
            tests = {
                item.name: Trials.of(ground, (item.plain, item.with_memory), folders[item.name])
                for item in LEARNERS
            }
            side_by_side([work for test in tests.values() for work in test.left()], TEAM, "tests")
            tested = time.perf_counter()
            for learner in LEARNERS:
                _conclude(learner, tests[learner.name], folders[learner.name])
        seconds = (trained - began, tested - trained, time.perf_counter() - tested)
        parts = "trainings {:.0f} s, tests {:.0f} s, tables and figures {:.0f} s".format(*seconds)
        print(f"figures, tables and models are in {self.output}; {sum(seconds):.0f} s: {parts}")

    def interrupted(self) -> str:
        """Nothing is lost, unless it is begun afresh."""
        return f"interrupted; go on with: {self.again(without=('--fresh',))}"


def remove(folders: Iterable[Path], only_check: bool = False) -> None:
    """Remove what an earlier demo left in these folders, and nothing else.

    Raises:
        ConfigurationError: one holds something else; all are kept.
    """
    there = [folder for folder in folders if folder.exists()]
    for folder in there:
        if any(folder.iterdir()) and not holds_training(folder / "agent"):
            raise ConfigurationError(
                f"fresh = True is not allowed: {str(folder)!r} holds no results of a demo, and is "
                "kept"
            )
    for folder in () if only_check else there:
        shutil.rmtree(folder)


def _conclude(learner: Learner, tests: Trials, folder: Path) -> None:
    """Write, print and draw what an agent and its rules brought."""
    report = tests.report()
    write(folder / "front.json", report)
    tables.console().print(front_table(learner, tests.ground, report))
    draw_front(folder / "front.png", learner, tests, report)
    draw_episodes(folder, learner, tests)


def front_table(learner: Learner, ground: CommittedRules, report: Mapping[str, Any]) -> Table:
    """A row a price: the agent, and the rules of both classes at its rate."""
    bucket = envelope_task(ground.setting).bucket
    caption = (
        f"{ground.episodes:,} episodes, the same for all, and all under the same token bucket: "
        f"{bucket.rate:g} tokens a step, at most {bucket.capacity:g}, {bucket.cost[0, 0]:g} a "
        "transmission. Rate per sensor and step; rules mixed to the agent's rate; paired "
        "differences to their MSE, with 95 % intervals over episodes."
    )
    table = Table(title=title_of(learner, report), box=box.SIMPLE_HEAD, caption=caption)
    for name in ("price", "rate", "MSE"):
        table.add_column(name, justify="right", no_wrap=True)
    for name in ("rules without memory", "rules with memory"):
        table.add_column(name, justify="right")
        table.add_column("difference", justify="right", no_wrap=True)
    for point in report["points"]:
        row = [f"{point['price']:.3g}", f"{point['rate']:.4f}", f"{point['mse']['mean']:.4f}"]
        for name in (learner.plain, learner.with_memory):
            below = point["rules"].get(name)
            row += [f"{below['mse']:.4f}", _share(below["difference"])] if below else ["–", "–"]
        table.add_row(*row)
    return table


def _share(interval: Mapping[str, float]) -> str:
    """A relative difference with its interval, in per cent."""
    mean, low, high = (100.0 * interval[key] for key in ("mean", "low", "high"))
    return f"{mean:+.1f} % [{low:+.1f}, {high:+.1f}]"


def title_of(learner: Learner, report: Mapping[str, Any]) -> str:
    """Who learned, and where its front lies, on average over the prices."""
    lies = [
        f"{100 * abs(mean):.1f} % {'below' if mean < 0 else 'above'} the rules {which} memory"
        for name, which in ((learner.plain, "without"), (learner.with_memory, "with"))
        if name in report["mean"]
        for mean in [report["mean"][name]["mean"]]
    ]
    return f"{learner.title}:\n" + (", ".join(lies) or "left of the rules at some price")


def draw_front(path: Path, learner: Learner, tests: Trials, report: Mapping[str, Any]) -> None:
    """The agent's front over everything that is known of its classes."""
    ground, remembering = tests.ground, tests.results(learner.with_memory)
    agent = [(point["rate"], Interval(**point["mse"])) for point in report["points"]]
    rates = np.linspace(0.0, 1.2 * max(rate for rate, _ in agent), 200)
    bound = ground.bound if learner.bounded else None
    layers = front_figure.Layers(
        single=ground.single(learner.plain),
        plain=[(point.rate, point.mse) for point in points_of(tests.results(learner.plain))],
        with_memory=[(point.rate, point.mse) for point in points_of(remembering)],
        rollout=ground.simulations(remembering) if learner.bounded else [],
        bound=[(rate, at_least(bound, rate)) for rate in rates] if bound else [],
        agent=agent,
    )
    caption = (
        f"{ground.episodes:,} test episodes, the same for all and under the same token bucket; "
        "bars are 95 % intervals.\nSingle rules and simulations, which ran on other or fewer "
        "episodes, are where they lie relative to the lines there."
    )
    front_figure.front(path, title_of(learner, report), caption, layers)


def draw_episodes(folder: Path, learner: Learner, tests: Trials) -> None:
    """One episode of the agent at its middle price, and of the rule whose rate is nearest."""
    agent, rules = tests.agent[len(tests.agent) // 2], tests.results(learner.with_memory)
    rate = agent.read(tests.work).rate.mean()
    rule = min(rules, key=lambda name: abs(rules[name].rate.mean() - rate))
    for name, test in (("agent", agent), ("rule", tests.rules[learner.with_memory][rule])):
        task = envelope_task(test.setting, test.options)
        trajectory = record_episode(task, test.make(task), test.seed)
        path, title = folder / f"episode_{name}.png", f"{test.name}\n{learner.name}"
        figures.episode(path, title, trajectory, task.bucket.capacity)
