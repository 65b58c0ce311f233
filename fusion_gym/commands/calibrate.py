r"""Calibrate agents with a rule at each price of a token, without training.

    fusion-gym calibrate --config runs/front/config.yaml \
        --policy model:runs/front/best_model.zip --output calibrated.zip

At each price the command mixes agent and rule, and sets the threshold of a request, by the cost of
tuning episodes. The rule alone stays unless another candidate is cheaper by two standard errors. Of
several agents the best one is taken at each price. The file is a policy:
``model:calibrated.zip,price=0.1``, or ``model:calibrated.zip`` for agents of one price, whose
environment has a fixed ``cost_weight``.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.table import Table

from fusion_gym import zoo
from fusion_gym.commands.command_line import (
    EnvironmentOptions,
    Long,
    OutputFile,
    PolicyNames,
    whole,
)
from fusion_gym.commands.search import token_prices
from fusion_gym.core.task import Task
from fusion_gym.entries import Options
from fusion_gym.envs.registration import make_task
from fusion_gym.errors import forbidden
from fusion_gym.output import tables
from fusion_gym.training import EPISODES
from fusion_gym.validation import refusal

if TYPE_CHECKING:
    from fusion_gym.training.calibration import CalibrationRow


@dataclass(frozen=True)
class Calibrate(EnvironmentOptions, Long):
    """Calibrate agents with a rule at each price of a token, without training."""

    policy: PolicyNames
    """Agents: model:PATH or zoo:NAME."""
    output: Annotated[Path, OutputFile(".zip")]
    """The file of the calibrated policy."""
    rule: str | None = None
    """Text of a priced_threshold, as search prints it; by default the start of a search."""
    prices: Annotated[int | None, whole(2, 100)] = None
    """Number of prices of a token over price_range, by default 5; not for agents of one price."""
    episodes: Annotated[int, whole(2, 100_000)] = EPISODES[1]
    """Tuning episodes of the last round."""

    keeps = False

    def run(self) -> None:
        """Calibrate, write the policy and print a row for each price."""
        # Imported here, because Stable-Baselines3 takes seconds to load.
        from fusion_gym.policies.saved import agent_files
        from fusion_gym.training.calibration import calibrate

        env_id, options = self.environment()
        task = make_task(env_id, **options)
        prices = self.calibrated_prices(env_id, options, task)
        named = [agent_file(name) for name in dict.fromkeys(chain(*self.policy))]
        episodes = EPISODES[0], self.episodes
        with tempfile.TemporaryDirectory() as folder:
            files = [file for path in named for file in agent_files(path, Path(folder))]
            rows = calibrate(task, files, prices, episodes, self.output, self.rule)
        tables.console().print(calibration_table(env_id, rows))
        print(f"model:{self.output}")

    def calibrated_prices(self, env_id: str, options: Options, task: Task) -> tuple[float, ...]:
        """Return the prices of the calibration: over the task's price_range, or its fixed price."""
        from fusion_gym.training.callbacks import PRICES

        price = task.reward.price
        if price.span is not None:
            return token_prices(env_id, options, task, self.prices or PRICES)
        if self.prices is not None:
            raise forbidden("prices", self.prices, "leave it out", "at one price (cost_weight)")
        if not price.fixed:
            raise refusal("cost_weight", price.fixed, "a positive price of a token")
        return (price.fixed,)


def agent_file(name: str) -> Path:
    """Return the file of an agent's text, which has no settings."""
    from fusion_gym.policies.saved import model_file

    kind, _, rest = name.partition(":")
    if kind not in ("model", "zoo") or "," in rest:
        raise refusal("policy", name, "model:PATH or zoo:NAME, an agent without settings")
    return model_file(zoo.model_path(rest) if kind == "zoo" else rest)


def calibration_table(env_id: str, rows: "Sequence[CalibrationRow]") -> Table:
    """Return the table of the calibration at each price."""
    cells = []
    for row in rows:
        relative = row.cost / row.rule_cost - 1.0, row.agent_cost / row.rule_cost - 1.0
        numbers = [f"{number:.4g}" for number in (*row.point, row.cost)]
        cells.append([*numbers, *(f"{share:+.1%}" for share in relative)])
    title = f"{env_id}: costs of tuning episodes; relative to the rule, negative: cheaper"
    heads = ("price", "agent", "mixture", "threshold", "cost", "relative", "agent alone")
    note = "mixture 1 with threshold 0 is the rule, 0 with 0 the agent's likeliest action"
    return tables.table_tables(title, heads, cells, note)
