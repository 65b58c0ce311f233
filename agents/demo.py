"""The project's main job, end to end: two fronts learned in minutes, and a fair comparison.

    fusion-gym demo [--output runs/demo] [--episodes 1000] [--fresh]

In the Tobit oscillator's benchmark setting it trains an agent for a scheduler and one for sensors
by themselves, side by side; both see the price of a token. It runs them at seven prices, and on the
same test episodes the rules of the committed envelopes that know as much, without memory and with
it; and it draws the agents over the rules. What is finished in the output folder is not done again,
and an interrupted training is gone on with.
"""

import hashlib
import itertools
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from rich import box
from rich.table import Table

from fusion_gym.evaluation.envelope import best_mse, points_of
from fusion_gym.evaluation.episodes import EpisodeResults, record_episode
from fusion_gym.evaluation.intervals import Interval, mean_interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from .command_line import Long
from .experiments.config import Course, load_suite
from .experiments.envelopes import (
    SHIPPED,
    EnvelopeStore,
    at_least,
    bound_of,
    envelope_task,
    policy_with_options,
    read_tests,
    rollout_of,
    run_test,
)
from .experiments.learning import LearningSetup
from .experiments.workers import Call, Folders, Pool, missing, run_training, side_by_side
from .input.options import Episodes, OutputFolder, Steps
from .output import figures, front_figure, tables
from .output.ending import ended_like_by_ctrl_c
from .output.files import write
from .output.folders import alone_in
from .output.progress import writing
from .training.config import Experiment
from .training.run import earlier, holds_training

SETTING = "tobit_oscillator"
TEAM = Pool(2)
# A course beside the one of the setting: its rules are those of sensors, and its agent is local.
LOCAL = Course(
    front="tobit_oscillator_front_local",
    memoryless="local_estimate",
    against="local_estimate_memory",
)


class Learner(NamedTuple):
    """A course of the demo: its name, its title, and its files.

    ``bounded`` where the proven bound and the rollout are for: a scheduler.
    """

    name: str
    title: str
    setup: LearningSetup
    timesteps: int | None
    bounded: bool = False

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.setup.folders.work

    @property
    def experiment(self) -> Experiment:
        """Its training."""
        return self.setup.front.changed(self.folder / "agent", timesteps=self.timesteps)

    @property
    def classes(self) -> dict[str, str]:
        """The classes of rules beside it, without memory and with it."""
        course = self.setup.course
        return {"without": str(course.memoryless), "with": course.against}

    def rules(self, name: str) -> dict[str, EpisodeResults]:
        """Return what the rules of a class do on the test episodes."""
        return read_tests(self.setup.rules(name), self.setup.folders.cache)

    @property
    def model(self) -> Path:
        """Its finished agent."""
        return self.folder / "agent" / "best_model.zip"

    def calls(self) -> list[Call]:
        """Return the tests of its agent and of its rules that were not run before."""
        rules = [test for name in self.classes.values() for test in self.setup.rules(name)]
        every = [*self.setup.agents(self.model), *rules]
        return missing(run_test, every, self.setup.folders.cache)


def learners_of(output: Path, episodes: int, timesteps: int | None) -> list[Learner]:
    """Return the demo's courses.

    Raises:
        ConfigurationError: a shipped file that is absent, damaged or made from other settings.
    """
    suite = load_suite("benchmark")
    store = EnvelopeStore(suite, SHIPPED)
    setting = next(setting for setting in suite.settings if setting.name == SETTING)
    suite = suite.model_copy(update={"episodes": episodes})

    def learner(name: str, title: str, course: Course | None, **more: Any) -> Learner:
        assert course is not None
        folder = output / name
        setup = LearningSetup(suite, setting, course, store, Folders(folder, folder))
        setup.check()
        return Learner(name, title, setup, timesteps, **more)

    return [
        learner(
            "scheduler",
            "A scheduler that sees all new measurements",
            setting.course,
            bounded=True,
        ),
        learner("alone", "Sensors by themselves, which hear the centre's estimate", LOCAL),
    ]


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
        learners = learners_of(self.output, self.episodes, self.timesteps)
        for learner in learners:
            self._check(learner)
        with ended_like_by_ctrl_c(), alone_in(self.output, "output"):
            for learner in learners if self.fresh else ():
                shutil.rmtree(learner.folder, ignore_errors=True)
            writing(("models, figures and tables", self.output))
            times = [time.perf_counter()]
            side_by_side(
                [Call(1.0, run_training, (learner.experiment,)) for learner in learners],
                TEAM,
                "trainings",
            )
            times.append(time.perf_counter())
            side_by_side([call for item in learners for call in item.calls()], TEAM, "tests")
            times.append(time.perf_counter())
            for learner in learners:
                _conclude(learner)
            times.append(time.perf_counter())
        seconds = [later - earlier for earlier, later in itertools.pairwise(times)]
        parts = "trainings {:.0f} s, tests {:.0f} s, tables and figures {:.0f} s".format(*seconds)
        print(f"figures, tables and models are in {self.output}; {sum(seconds):.0f} s: {parts}")

    def _check(self, learner: Learner) -> None:
        """Whether the learner's folder may be gone on with, or removed.

        Raises:
            ConfigurationError: it holds another training, or something else than a demo.
        """
        folder, begun = learner.folder, holds_training(learner.folder / "agent")
        if not self.fresh:
            earlier(learner.experiment, folder / "agent", begun)
        elif folder.exists() and any(folder.iterdir()) and not begun:
            raise ConfigurationError(
                f"fresh = True is not allowed: {str(folder)!r} holds no results of a demo, and is "
                "kept"
            )

    def interrupted(self) -> str:
        """Nothing is lost, unless it is begun afresh."""
        return f"interrupted; go on with: {self.again(without=('--fresh',))}"


def _conclude(learner: Learner) -> None:
    """Write, print and draw what an agent and its rules brought."""
    report = report_of(learner)
    write(learner.folder / "front.json", report)
    tables.console().print(front_table(learner, report))
    draw_front(learner, report)
    draw_episodes(learner)


def report_of(learner: Learner) -> dict[str, Any]:
    """Return the agent at its prices beside the rules of each class at its own rates.

    A point has ``price``, ``rate``, ``mse`` and of each class the rules' ``mse`` and the paired
    ``difference`` to it, as a share of it, with its 95 % interval over episodes; nothing of a
    class whose rules all transmit more. ``mean`` is that of the differences at all prices.
    """
    setup = learner.setup
    results = list(read_tests(setup.agents(learner.model), setup.folders.cache).values())
    points: list[dict[str, Any]] = [
        {
            "price": price,
            "rate": float(value.rate.mean()),
            "mse": mean_interval(value.mse)._asdict(),
            "rules": {},
        }
        for price, value in zip(setup.prices, results, strict=True)
    ]
    means = {}
    for name in learner.classes.values():
        rules, shares = learner.rules(name), []
        for point, value in zip(points, results, strict=True):
            below = best_mse(rules, point["rate"])
            if below is not None:
                shares.append((value.mse - below) / below.mean())
                point["rules"][name] = {
                    "mse": float(below.mean()),
                    "difference": mean_interval(shares[-1])._asdict(),
                }
        if len(shares) == len(points):
            means[name] = mean_interval(np.mean(shares, axis=0))._asdict()
    return {
        "setting": setup.setting.name,
        "env": setup.setting.environment.id,
        "options": setup.setting.environment.options,
        "episodes": setup.suite.episodes,
        "seed": setup.suite.seed,
        "model": hashlib.sha256(learner.model.read_bytes()).hexdigest(),
        "classes": {name: setup.envelope(name)["sha256"] for name in learner.classes.values()},
        "points": points,
        "mean": means,
    }


def front_table(learner: Learner, report: Mapping[str, Any]) -> Table:
    """A row a price: the agent, and the rules of both classes at its rate."""
    bucket = envelope_task(learner.setup.setting).bucket
    caption = (
        f"{report['episodes']:,} episodes, the same for all, and all under the same token bucket: "
        f"{bucket.rate:g} tokens a step, at most {bucket.capacity:g}, {bucket.cost[0, 0]:g} a "
        "transmission. Rate per sensor and step; rules mixed to the agent's rate; paired "
        "differences to their MSE, with 95 % intervals over episodes."
    )
    table = Table(title=title_of(learner, report), box=box.SIMPLE_HEAD, caption=caption)
    for name in ("price", "rate", "MSE"):
        table.add_column(name, justify="right", no_wrap=True)
    for which in learner.classes:
        table.add_column(f"rules {which} memory", justify="right")
        table.add_column("difference", justify="right", no_wrap=True)
    for point in report["points"]:
        row = [f"{point['price']:.3g}", f"{point['rate']:.4f}", f"{point['mse']['mean']:.4f}"]
        for name in learner.classes.values():
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
        for which, name in learner.classes.items()
        if name in report["mean"]
        for mean in [report["mean"][name]["mean"]]
    ]
    return f"{learner.title}:\n" + (", ".join(lies) or "left of the rules at some price")


def draw_front(learner: Learner, report: Mapping[str, Any]) -> None:
    """The agent's front over everything that is known of its classes."""
    plain, remembering = (learner.rules(name) for name in learner.classes.values())
    agent = [(point["rate"], Interval(**point["mse"])) for point in report["points"]]
    rates = np.linspace(0.0, 1.2 * max(rate for rate, _ in agent), 200)
    store, setting = learner.setup.store, learner.setup.setting
    bound = bound_of(store.results / setting.name) if learner.bounded else None
    layers = front_figure.Layers(
        single=single_rules(learner),
        plain=[(point.rate, point.mse) for point in points_of(plain)],
        with_memory=[(point.rate, point.mse) for point in points_of(remembering)],
        rollout=simulations(learner, remembering) if learner.bounded else [],
        bound=[(rate, at_least(bound, rate)) for rate in rates] if bound else [],
        agent=agent,
    )
    caption = (
        f"{report['episodes']:,} test episodes, the same for all and under the same token bucket; "
        "bars are 95 % intervals.\nSingle rules and simulations, which ran on other or fewer "
        "episodes, are where they lie relative to the lines there."
    )
    front_figure.front(learner.folder / "front.png", title_of(learner, report), caption, layers)


def single_rules(learner: Learner) -> list[tuple[float, float]]:
    """Return rate and error of every tuned rule without memory.

    Each is as far from its envelope as on tuning episodes, which are easier or harder than those of
    the test.
    """
    content = learner.setup.envelope(learner.classes["without"])
    vertices = sorted(content["vertices"], key=lambda vertex: vertex["tuning_rate"])
    rates = [vertex["tuning_rate"] for vertex in vertices]
    harder = [v["test_mse"]["mean"] / v["tuning_mse"]["mean"] for v in vertices]
    return [
        (row["rate"], float(row["mse"] * np.interp(row["rate"], rates, harder)))
        for row in learner.setup.envelopes["curves"]
        if row["family"] in content["families"] and row["options"] in ({}, content["options"])
    ]


def simulations(learner: Learner, rules: Mapping[str, EpisodeResults]) -> list[tuple[float, float]]:
    """Return rate and error of the rollout, its error as a share of the rules' on its episodes.

    Its few episodes are easier or harder than all of them by more than what it brings.
    """
    store, setting = learner.setup.store, learner.setup.setting
    rollout, episodes = rollout_of(store.results / setting.name)
    result = []
    for point in rollout if episodes <= learner.setup.suite.episodes else ():
        below = best_mse(rules, point.rate)
        if below is not None:
            share = point.mse / below[:episodes].mean()
            result.append((point.rate, share * below.mean()))
    return result


def draw_episodes(learner: Learner) -> None:
    """One episode of the agent at its middle price, and of the rule whose rate is nearest."""
    setup, name = learner.setup, learner.classes["with"]
    place = len(setup.prices) // 2
    agent, rules = setup.agents(learner.model)[place], learner.rules(name)
    (result,) = read_tests([agent], setup.folders.cache).values()
    nearest = min(rules, key=lambda rule: abs(rules[rule].rate.mean() - result.rate.mean()))
    options = setup.envelope(name)["options"].items()
    who = policy_with_options(f"agent at price {setup.prices[place]:.4g}", options)
    rule = next(test for test in setup.rules(name) if test.name == nearest)
    for kind, test, label in (("agent", agent, who), ("rule", rule, rule.name)):
        task = test.task()
        trajectory = record_episode(task, make_policy(test.policy, task), test.seed)
        path, title = learner.folder / f"episode_{kind}.png", f"{label}\n{learner.name}"
        figures.episode(path, title, trajectory, task.bucket.capacity)
