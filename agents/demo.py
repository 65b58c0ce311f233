"""The project's main job, end to end: two fronts learned in minutes, and a fair comparison.

    fusion-gym demo [--output runs/demo] [--episodes 1000] [--fresh]

In the Tobit oscillator's benchmark setting it trains an agent for a scheduler and one for local
sensors, side by side; both see the price of a token. It runs them at seven prices, and on the
same test episodes the rules of the committed envelopes that know as much, without memory and with
it; and it draws the agents over the rules. What is finished in the output folder is not done again,
and an interrupted training is gone on with.
"""

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from rich.table import Table

from fusion_gym.evaluation.envelope import best_mse, points_of
from fusion_gym.evaluation.episodes import EpisodeResults, record_episode
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from .command_line import Long
from .experiments.config import Setting, Suite, front_prices, load_suite
from .experiments.envelopes import (
    SHIPPED,
    EnvelopeStore,
    Test,
    at_least,
    bound_of,
    envelope_task,
    policy_with_options,
    read_tests,
    rollout_of,
    rule_tests,
    run_test,
)
from .experiments.figures import envelope_series, fine_rates, limits_of
from .experiments.tables import Row
from .experiments.workers import Call, Folders, Pool, missing, run_training, side_by_side
from .input.options import Episodes, OutputFolder, Steps
from .output import figures, palette, tables
from .output.ending import ended_like_by_ctrl_c
from .output.files import write
from .output.folders import alone_in
from .output.markup import NONE, share
from .output.pareto_figure import Differences, Panel, Series, draw_pareto
from .output.progress import writing
from .training.checked import load_checked
from .training.config import Experiment
from .training.run import earlier, holds_training

SETTING = "tobit_oscillator"
TEAM = Pool(2)
# The training's config, and the classes of rules beside its agent, without memory and with it.
COMPARED = {
    "scheduler": ("tobit_oscillator_front", "sensors", "sensors_memory"),
    "local": ("tobit_oscillator_front_local", "local_estimate", "local_estimate_memory"),
}
TITLES = {
    "scheduler": "A scheduler that sees all new measurements",
    "local": "Local sensors, which receive the centre's estimate",
}


class Learner(NamedTuple):
    """An agent of the demo, the committed rules beside it, and where its files are.

    ``classes`` names the rules' classes, ``"without"`` memory and ``"with"`` it.
    """

    name: str
    suite: Suite
    setting: Setting
    envelopes: Row
    experiment: Experiment
    classes: dict[str, str]
    folders: Folders

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.folders.results

    @property
    def model(self) -> Path:
        """The file of the finished agent."""
        return Path(self.experiment.output) / "best_model.zip"

    @property
    def prices(self) -> list[float]:
        """The prices at which the agent is tested."""
        return front_prices(self.setting.price_range, self.suite.prices)

    @property
    def agents(self) -> list[Test]:
        """The tests of the finished agent at each price."""
        priced = ("cost_weight", "price_range")
        world = self.experiment.environment.options.items()
        options = tuple((key, value) for key, value in world if key not in priced)
        requested = (self.suite.prices, self.suite.episodes, self.suite.seed)
        return Test.at_prices(self.setting, options, f"model:{self.model}", *requested)

    def envelope(self, which: str) -> Row:
        """Return the committed rules without memory, or with it."""
        return dict(self.envelopes["classes"][self.classes[which]])

    def tests(self, which: str) -> list[Test]:
        """Return the tests of the rules without memory, or with it."""
        vertices = self.envelope(which)["vertices"]
        return rule_tests(self.setting, vertices, self.suite.episodes, self.suite.seed)

    def rules(self, which: str) -> dict[str, EpisodeResults]:
        """Return what the rules without memory, or with it, do on the test episodes."""
        return read_tests(self.tests(which), self.folders.cache)

    def calls(self) -> list[Call]:
        """Return the tests of its agent and of its rules that were not run before."""
        rules = [test for which in self.classes for test in self.tests(which)]
        return missing(run_test, [*self.agents, *rules], self.folders.cache)


def learners_of(output: Path, episodes: int, timesteps: int | None) -> list[Learner]:
    """Return the agents of the demo, to be trained.

    Raises:
        ConfigurationError: a shipped file that is absent, damaged or made from other settings.
    """
    suite = load_suite("benchmark")
    setting = next(setting for setting in suite.settings if setting.name == SETTING)
    envelopes = EnvelopeStore(suite, SHIPPED).read(setting)
    suite = suite.model_copy(update={"episodes": episodes})
    result = []
    for name, (config, without, remembering) in COMPARED.items():
        experiment = load_checked(Experiment, config)
        experiment = experiment.changed(output / name / "agent", timesteps=timesteps)
        classes = {"without": without, "with": remembering}
        folders = Folders(output / name, output / name)
        result.append(Learner(name, suite, setting, envelopes, experiment, classes, folders))
    return result


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
            for learner in learners:
                if self.fresh and learner.folder.exists():
                    shutil.rmtree(learner.folder)
            writing(("models, figures and tables", self.output))
            calls = [
                Call(1.0, run_training, (learner.experiment,), learner.experiment)
                for learner in learners
            ]
            side_by_side(calls, TEAM, "trainings")
            side_by_side([call for learner in learners for call in learner.calls()], TEAM, "tests")
            for learner in learners:
                report = report_of(learner)
                write(learner.folder / "front.json", report)
                tables.console().print(front_table(learner, report))
                draw_front(learner, report)
                draw_episodes(learner)
        print(f"figures, tables and models are in {self.output}")

    def _check(self, learner: Learner) -> None:
        """Whether the learner's folder may be gone on with, or removed.

        Raises:
            ConfigurationError: it holds another training, or something else than a demo.
        """
        folder, training = learner.folder, Path(learner.experiment.output)
        if not self.fresh:
            earlier(learner.experiment, training, holds_training(training))
        elif folder.exists() and any(folder.iterdir()) and not holds_training(training):
            raise ConfigurationError(
                f"fresh = True is not allowed: {str(folder)!r} holds no results of a demo, and is "
                "kept"
            )

    def interrupted(self) -> str:
        """Nothing is lost, unless it is begun afresh."""
        return f"interrupted; go on with: {self.again(without=('--fresh',))}"


def report_of(learner: Learner) -> dict[str, Any]:
    """Return the agent at its prices beside the rules of each class at its own rates.

    A point has ``price``, ``rate``, ``mse`` and of each class the rules' ``mse`` and the paired
    ``difference`` to it, as a share of it, with its 95 % interval over episodes; nothing of a
    class whose rules all transmit more. ``mean`` is the mean of the differences at all prices.
    """
    suite, environment = learner.suite, learner.setting.environment
    points: list[dict[str, Any]] = []
    shares: dict[str, list[Any]] = {name: [] for name in learner.classes.values()}
    results = read_tests(learner.agents, learner.folders.cache).values()
    rules = {name: learner.rules(which) for which, name in learner.classes.items()}
    for price, value in zip(learner.prices, results, strict=True):
        rate = float(value.rate.mean())
        point = {"price": price, "rate": rate, "mse": mean_interval(value.mse)._asdict()}
        points.append(point | {"rules": {}})
        for name, own in rules.items():
            below = best_mse(own, rate)
            if below is not None:
                shares[name].append((value.mse - below) / below.mean())
                difference = mean_interval(shares[name][-1])._asdict()
                beside = {"mse": float(below.mean()), "difference": difference}
                points[-1]["rules"][name] = beside
    return {
        "setting": learner.setting.name,
        "env": environment.id,
        "options": environment.options,
        "episodes": suite.episodes,
        "seed": suite.seed,
        "model": hashlib.sha256(learner.model.read_bytes()).hexdigest(),
        "classes": {of: learner.envelope(which)["sha256"] for which, of in learner.classes.items()},
        "points": points,
        "mean": {
            name: mean_interval(np.mean(own, axis=0))._asdict()
            for name, own in shares.items()
            if len(own) == len(points)
        },
    }


def front_table(learner: Learner, report: Mapping[str, Any]) -> Table:
    """A row a price: the agent, and the rules of both classes at its rate."""
    bucket = envelope_task(learner.setting).bucket
    caption = (
        f"{report['episodes']:,} episodes, the same for all, and all under the same token bucket: "
        f"{bucket.rate:g} tokens a step, at most {bucket.capacity:g}, {bucket.cost[0, 0]:g} a "
        "transmission. Rate per sensor and step; rules mixed to the agent's rate; paired "
        "differences to their MSE, with 95 % intervals over episodes."
    )
    heads = ["price", "rate", "MSE"]
    for which in learner.classes:
        heads += [f"rules\n{which}\nmemory", "difference"]
    rows = []
    for point in report["points"]:
        row = [f"{point['price']:.3g}", f"{point['rate']:.4f}", f"{point['mse']['mean']:.4f}"]
        for name in learner.classes.values():
            below = point["rules"].get(name)
            row += [f"{below['mse']:.4f}", share(below["difference"])] if below else [NONE, NONE]
        rows.append(row)
    return tables.table_tables(title_of(learner, report), heads, rows, caption)


def title_of(learner: Learner, report: Mapping[str, Any]) -> str:
    """Who learned, and where its front lies, on average over the prices."""
    lies = [
        f"{100 * abs(mean):.1f} % {'below' if mean < 0 else 'above'} the rules {which} memory"
        for which, name in learner.classes.items()
        if name in report["mean"]
        for mean in [report["mean"][name]["mean"]]
    ]
    return f"{TITLES[learner.name]}:\n" + (", ".join(lies) or "left of the rules at some price")


def draw_front(learner: Learner, report: Mapping[str, Any]) -> None:
    """The agent's front over everything that is known of its classes.

    The band and the strip below hold 95 % intervals over episodes. The proven bound and the rollout
    are a scheduler's.
    """
    always = learner.envelopes["always"]
    rates, scheduler = fine_rates(always), not learner.experiment.environment.local
    rules = {which: learner.rules(which) for which in learner.classes}
    style = palette.AGENTS_MEMORY._replace(label="the agent, at seven prices")
    bound = bound_of(SHIPPED / SETTING) if scheduler else None
    points = sorted(report["points"], key=lambda point: float(point["rate"]))
    marks = [(point["rate"], point["mse"]["mean"]) for point in points]
    band = [(point["rate"], point["mse"]["low"], point["mse"]["high"]) for point in points]
    simulated = simulations(rules["with"], report["episodes"]) if scheduler else []
    series = [
        envelope_series(palette.RULES, points_of(rules["without"]), rates),
        envelope_series(palette.RULES_MEMORY, points_of(rules["with"]), rates),
        *([Series(palette.ROLLOUT, [], simulated)] if simulated else []),
        Series(style, marks, marks, band),
    ]
    panel = Panel(
        learner.name, series, single_rules(learner),
        [(rate, at_least(bound, rate)) for rate in rates] if bound else [], None,
        [Differences(style, [
            (point["rate"], *(own["difference"][end] for end in ("mean", "low", "high")))
            for point in points
            if (own := point["rules"].get(learner.classes["with"]))
        ])],
    )  # fmt: skip
    title = f"{title_of(learner, report)}; {report['episodes']:,} test episodes"
    draw_pareto([learner.folder / "front.png"], title, panel, [], limits_of(always, [panel]))


def single_rules(learner: Learner) -> list[list[tuple[float, float]]]:
    """Return rate and error of the tuned rules of each family without memory.

    Each is as far from its envelope as on tuning episodes, which are easier or harder than the
    test's.
    """
    content = learner.envelope("without")
    vertices = sorted(content["vertices"], key=lambda vertex: vertex["tuning_rate"])
    rates = [vertex["tuning_rate"] for vertex in vertices]
    harder = [v["test_mse"]["mean"] / v["tuning_mse"]["mean"] for v in vertices]
    curves: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row in learner.envelopes["curves"]:
        if row["family"] in content["families"] and row["options"] in ({}, content["options"]):
            error = float(row["mse"] * np.interp(row["rate"], rates, harder))
            key = row["family"], str(row["options"])
            curves.setdefault(key, []).append((row["rate"], error))
    return list(curves.values())


def simulations(rules: Mapping[str, EpisodeResults], episodes: int) -> list[tuple[float, float]]:
    """Return rate and error of the rollout, its error as a share of the rules' on its episodes.

    Its few episodes are easier or harder than all of them by more than what it brings.
    """
    rollout, own = rollout_of(SHIPPED / SETTING)
    errors = [(p, best_mse(rules, p.rate)) for p in rollout if own <= episodes]
    return [
        (p.rate, p.mse / below[:own].mean() * below.mean())
        for p, below in errors
        if below is not None
    ]


def draw_episodes(learner: Learner) -> None:
    """One episode of the agent at its middle price, and of the rule whose rate is nearest."""
    place, rules = len(learner.prices) // 2, learner.rules("with")
    agent = learner.agents[place]
    (result,) = read_tests([agent], learner.folders.cache).values()
    nearest = min(rules, key=lambda rule: abs(rules[rule].rate.mean() - result.rate.mean()))
    rule = next(test for test in learner.tests("with") if test.name == nearest)
    options = learner.envelope("with")["options"].items()
    who = policy_with_options(f"agent at price {learner.prices[place]:.4g}", options)
    for kind, test, label in (("agent", agent, who), ("rule", rule, rule.name)):
        task = test.task()
        trajectory = record_episode(task, make_policy(test.policy, task), test.seed)
        path, title = learner.folder / f"episode_{kind}.png", f"{label}\n{learner.name}"
        figures.episode(path, title, trajectory, task.bucket.capacity)
