"""Print what no policy can undercut: floors, and a proven lower bound of the error at each rate.

    python -m agents.benchmark.bound --env fusion_gym/TobitOscillator-v1 \\
        --set filter=tobit random_start=true token_rate=2 --filters tobit adf --rates 0.03 0.1

Rates are transmissions a sensor and step; ``docs/bounds.md`` has the proof and says where it does
not apply. There only what is left where everything is delivered is printed.
"""

from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from agents.benchmark.tables import write_rows
from fusion_gym.commands.command_line import Long, SetOptions
from fusion_gym.commands.options import Between, Episodes, OutputFile, OutputFolder, Seed, Whole
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.floor import everything_delivered, everything_delivered_tasks
from fusion_gym.output import tables as terminal
from fusion_gym.output.files import write
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.settings import parse_settings
from fusion_gym.solvers.silence import SilenceBound, silence_bound, silence_model
from fusion_gym.validation import choice

_WEIGHTS = ("mse", "reward")


@dataclass(frozen=True)
class Bound(Long):
    """Print what no policy can undercut: floors, and a proven lower bound at each rate."""

    program = "python -m agents.benchmark.bound"

    env: str
    """Id of a registered environment."""
    options: SetOptions = ()
    """Options of gym.make for the environment."""
    rates: Annotated[tuple[float, ...], Between(0.0, 1.0)] = ()
    """Transmissions a sensor and step; without any, only what is left with everything delivered."""
    filters: tuple[str, ...] = ()
    """Filters to take everything in with; by default the environment's own."""
    weights: str = "mse"
    """What weighs the states: mse (each with 1) or reward (as the reward does)."""
    accuracy: Annotated[float, Between(0.0, 0.5)] = 0.01
    """What the bound may lose by its lattices, relatively."""
    points: Annotated[int, Whole(1000, 100_000_000)] = 3_000_000
    """Points of a lattice at most; the accuracy suffers before."""
    episodes: Episodes = 1000
    """Episodes in which everything is delivered."""
    seed: Seed = 0
    """Seed of the first episode."""
    json: Annotated[Path | None, OutputFile(".json")] = None
    """Write the results to this file."""
    tables: Annotated[Path | None, OutputFolder()] = None
    """Write the bound at the rates as bounds.csv and bounds_at.csv into this setting's folder."""

    keeps = False

    def run(self) -> None:
        """Work out floors and bound, write and print them."""
        options = parse_settings("option", list(chain(*self.options)))
        choice("weights", self.weights, _WEIGHTS)
        task, open_wide = (
            make_task(self.env, **options),
            everything_delivered_tasks(self.env, options, self.filters),
        )
        reward = task.reward.error_weight * task.reward.state_weights[:, 0]
        weights = reward if self.weights == "reward" else None
        if self.rates:
            silence_model(task, weights)  # refuses what the bound does not hold for
        report: dict[str, Any] = {
            "env": self.env,
            "settings": task.settings,
            "horizon": task.horizon,
            "sensors": task.sensors,
            "weights": self.weights,
        }
        if self.json is not None:
            writing(("the results", self.json))
        if self.rates:
            report |= summary(self._bound(task, weights), self.rates)
        steps = len(open_wide) * self.episodes * task.horizon
        with progress_bar(steps, "everything delivered") as bar:
            delivered = everything_delivered(
                self.env, options, self.filters, self.episodes, self.seed, bar.update
            )
        report["everything_delivered"] = {
            name: value._asdict() for name, value in delivered.items()
        }
        write(self.json, report)
        if self.tables is not None and self.rates:
            write_rows(self.tables, "bounds", [report | cost for cost in report["costs"]])
            write_rows(self.tables, "bounds_at", report["bounds"])
        console = terminal.console()
        console.print(_floors(report))
        if self.rates:
            console.print(_table(report))

    def _bound(self, task: Task, weights: Any) -> SilenceBound:
        with progress_bar(len(self.rates), "bounding", unit="rates") as bar:

            def progress_line(done: int, text: str) -> None:
                bar.say(text)
                bar.reach(done)

            bound = silence_bound(
                task, self.rates, weights, self.accuracy, self.points, progress=progress_line
            )
            bar.reach(len(self.rates))
            return bound


def summary(bound: SilenceBound, rates: tuple[float, ...]) -> dict[str, Any]:
    """The bound at each rate, and the costs that show it, as the JSON holds them."""
    rows = []
    for rate in rates:
        value, visible = bound.at(rate)
        rows.append({"rate": rate, "bound": value, "price": visible.price, "gap": visible.gap})
    costs = [asdict(cost) | {"gap": cost.gap} for cost in bound.costs]
    return {"floor": bound.floor, "bounds": rows, "costs": costs}


def _floors(report: dict[str, Any]) -> Table:
    delivered = report["everything_delivered"].items()
    rows = [(f"filter {name}", terminal.table_number(value)) for name, value in delivered]
    if "floor" in report:
        rows.append(("uncensored, Kalman filter: unavoidable", f"{report['floor']:.4g}"))
    heads = ("everything delivered", "MSE, every state with 1")
    return terminal.table_tables(f"{report['env']}: floors", heads, rows)


def _table(report: dict[str, Any]) -> Table:
    rows = [
        (f"{row['rate']:.4g}", f"{row['bound']:.5g}", f"{row['price']:.3g}", f"{row['gap']:.2%}")
        for row in report["bounds"]
    ]
    heads = ("rate", "error at least", "price of a packet", "gap at this price")
    return terminal.table_tables("no policy has less", heads, rows)


if __name__ == "__main__":
    Bound.main()
