r"""Search the parameters of a rule; an interrupted search can be resumed.

    fusion-gym search --env fusion_gym/LinearFusion-v2 --output runs/search \
        --set system=plant.yaml token_rate=.5

Without ``--rule`` one ``priced_threshold`` serves all prices: its threshold depends on the price,
the tokens and the age. The search over its dozen parameters (CMA-ES) starts from the best single
threshold at each price. With ``--rule`` every price has a search of its own over the parameters
that the text leaves, with a value for each sensor where the rule allows it. The prices are evenly
spaced on a logarithmic scale over the price_range of the environment, by default ``auto``.

The command writes ``generations.json`` into the output folder after every generation, and
``search.json`` at the end. The latter contains the rule at each price as text, its cost on fresh
episodes, and the cost of the best single threshold there.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from fusion_gym.commands.command_line import OUTPUT_FOLDER, EnvironmentOptions, Long, whole
from fusion_gym.core.task import Task
from fusion_gym.entries import Options, Plain
from fusion_gym.envs.registration import make_task
from fusion_gym.errors import forbidden
from fusion_gym.evaluation import rule_search
from fusion_gym.output import tables
from fusion_gym.output.files import check_inputs, folder_refusal, lock_folder, read_json, write
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.validation import ConfigurationError

_GENERATIONS, _RESULT = "generations.json", "search.json"


@dataclass(frozen=True)
class Search(EnvironmentOptions, Long):
    """Search the parameters of a rule."""

    output: Annotated[Path, OUTPUT_FOLDER]
    """Folder of the search."""
    class_name: Annotated[rule_search.ClassName | None, tyro.conf.arg(name="class")] = None
    """Who decides: scheduler with all measurements (default), every sensor locally, or centre."""
    rule: str | None = None
    """Text of another rule to search; it decides by its own knowledge."""
    prices: Annotated[int, whole(2, 100)] = 5
    """Number of prices of a token, from the lowest to the highest."""
    generations: Annotated[int, whole(1, 10_000)] = 30
    """Number of generations."""
    resume: bool = False
    """Continue after the generations in the folder."""

    def run(self) -> None:
        """Search, write and print the rule."""
        env_id, options = self.environment()
        task = make_task(env_id, **options)
        prices = token_prices(env_id, options, task, self.prices)
        if self.rule is None:
            search = rule_search.search_of_class(
                self.class_name or "scheduler", task, prices, generations=self.generations
            )
        else:
            own = task, prices, self.rule
            try:
                search = rule_search.RuleSearch(*own, generations=self.generations)
            except ConfigurationError as error:
                raise ConfigurationError(f"rule = {self.rule!r} is not allowed: {error}") from None
            if self.class_name is not None:
                raise forbidden("class", self.class_name, "leave it out", "with --rule")
        chosen = self.class_name or ("scheduler" if self.rule is None else None)
        inputs: Plain = {"env": env_id, "class": chosen, "rule": self.rule}
        inputs |= {"prices": search.prices, "generations": self.generations}
        inputs |= {"settings": search.task.settings}
        self.earlier(inputs)  # refuses before it creates a folder
        with lock_folder(self.output, "output"):
            writing(("the generations and the rule", self.output))
            result = self.continued(search, inputs)
            write(self.output / _RESULT, asdict(result) | {"inputs": inputs})
        print("\n".join(dict.fromkeys(result.policies)))
        tables.console().print(result_table(env_id, result))

    def continued(self, search: rule_search.RuleSearch, inputs: Plain) -> rule_search.SearchResult:
        """Run the search after its earlier generations, and write every generation to the file."""
        generations = self.earlier(inputs)
        initial = len(generations)

        def keep(*more: rule_search.Generation) -> None:
            generations.extend(more)
            plain = [asdict(generation) for generation in generations]
            write(self.output / _GENERATIONS, {"inputs": inputs, "generations": plain})

        keep()
        count = self.generations * len(search.parts)
        with progress_bar(count, "searching", initial, unit="generations") as bar:

            def progress(generation: rule_search.Generation) -> None:
                keep(generation)
                bar.say(f"best {min(generation.objectives) - 1.0:+.1%} over a single threshold")
                bar.update()

            return rule_search.search_rule(search, tuple(generations), progress)

    def earlier(self, inputs: Plain) -> list[rule_search.Generation]:
        """Return the generations in the folder, of the same search."""
        # Imported here, because pydantic takes a tenth of a second to load.
        from fusion_gym.training.config import checked

        path = self.output / _GENERATIONS
        if not self.resume:
            if path.exists() or (self.output / _RESULT).exists():
                raise folder_refusal(self.output, "a search")
            return []
        if not path.exists():
            place = f"output = {str(self.output)!r}"
            raise ConfigurationError(f"{place} holds no search: nothing to resume")
        content = read_json(path, "output")
        check_inputs(inputs, content.get("inputs"), f"the search in {str(self.output)!r}")
        source = f"output = {str(path)!r}"
        result = checked(list[rule_search.Generation], content.get("generations"), source)
        numbers = [generation.number for generation in result]
        count = self.generations * (1 if self.rule is None else self.prices)
        if numbers != list(range(min(len(numbers), count))):
            raise ConfigurationError(f"{source} does not hold the first generations of a search")
        return result

    def interrupted(self) -> str:
        """Return how to resume, if the search has begun."""
        begun = (self.output / _GENERATIONS).exists()
        return super().interrupted() if begun else "interrupted before the search began"


def token_prices(env_id: str, options: Options, task: Task, count: int) -> tuple[float, ...]:
    """Return prices at even logarithmic distances over the task's price_range, or over "auto"."""
    span = task.reward.price.span
    if span is None:
        drawn = {"price_range": "auto", "cost_weight": "random"}
        span = make_task(env_id, **(options | drawn)).reward.price.span
    assert span is not None
    return tuple(float(f"{price:.5g}") for price in np.geomspace(*span, count))


def result_table(env_id: str, result: rule_search.SearchResult) -> Table:
    """Return the table of the costs of a searched rule and of the best single thresholds."""
    columns = result.prices, result.costs, result.threshold_costs
    rows = [
        (f"{price:.4g}", f"{cost:.4g}", f"{single:.4g}", f"{cost / single - 1.0:+.1%}")
        for price, cost, single in zip(*columns, strict=True)
    ]
    title = f"{env_id}: costs on fresh episodes"
    heads = ("price", "cost of the rule", "of the best single threshold", "relative")
    note = f"cost = error + price · tokens, a step; relative in the mean {result.relative:+.1%}"
    return tables.table_tables(title, heads, rows, note)
