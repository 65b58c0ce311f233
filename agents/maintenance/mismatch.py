"""Measure whether a training may take the mismatch for the error: the cross term, in a setting.

    python -m fusion_gym.agents.maintenance mismatch \\
        --env fusion_gym/UnknownInput-v1 --set token_rate=2
    python -m fusion_gym.agents.maintenance mismatch \\
        --config correlated_tracking_front --episodes 2000

The error ‖x - x̂‖² of the centre's estimate x̂ is a floor ‖x - x*‖², a mismatch ‖x* - x̂‖² and a
cross term, with x* the estimate that takes in every measurement. ``training.error: mismatch`` is
right where the cross term is zero under every policy; ``docs/learning.md`` has the rest.
"""

from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from fusion_gym.envs.privileged import reference_system
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.cross_term import CrossTerm, cross_terms, usual_policies, worst
from fusion_gym.policies.registry import make_policy

from ..command_line import EnvironmentOptions, Long, PolicyNames
from ..input.options import OutputFile, Seed, Whole
from ..output import tables
from ..output.files import write
from ..output.progress import progress_bar, writing
from ..training.environment import environment_of


@dataclass(frozen=True)
class Mismatch(EnvironmentOptions, Long):
    """Measure whether a training may take the mismatch for the error: the cross term."""

    filter: str | None = None
    """Filter that takes in every measurement; by default the config's, or that of a memory."""
    policies: PolicyNames = ()
    """Policies to measure it under; by default random ones, always, and one on the value."""
    episodes: Annotated[int, Whole(2, 100_000_000)] = 500
    """Episodes of each policy."""
    seed: Seed = 0
    """Seed of the first episode."""
    json: Annotated[Path | None, OutputFile(".json")] = None
    """Write the results to this file."""

    keeps = False

    def run(self) -> None:
        """Measure, write and print the cross term under each policy."""
        env_id, options, experiment = environment_of(self.env, self.config, self.options)
        task, filter_name = make_task(env_id, **options), self.filter
        if filter_name is None and experiment is not None:
            filter_name = experiment.training.error_filter
        system = reference_system(env_id, options, filter_name)
        names = list(dict.fromkeys(chain(*self.policies))) or usual_policies(task)
        policies = {name: make_policy(name, task) for name in names}
        if self.json is not None:
            writing(("the results", self.json))
        total = len(policies) * self.episodes * task.horizon
        with progress_bar(total, "measuring the cross term") as bar:
            terms = cross_terms(
                task, system, policies, self.episodes, self.seed, progress=bar.update
            )
        report: dict[str, Any] = {
            "env": env_id,
            "settings": task.settings,
            "filter": filter_name,
            "episodes": self.episodes,
            "seed": self.seed,
            "horizon": task.horizon,
            "policies": {name: _summary(part) for name, part in terms.items()},
            "compatible": all(part.compatible for part in terms.values()),
        }
        write(self.json, report)
        console = tables.console()
        console.print(_table(f"{env_id}: {self.episodes} episodes, seed {self.seed}", terms))
        console.print(_verdict(terms))


def _summary(term: CrossTerm) -> dict[str, Any]:
    """A policy's cross term as the JSON holds it."""
    plain = term._asdict() | {"share": term.share._asdict()}
    return plain | {"compatible": term.compatible}


def _table(title: str, terms: dict[str, CrossTerm]) -> Table:
    rows = [
        (
            name,
            f"{part.rate:.3f}",
            *(f"{value:.4g}" for value in (part.error, part.floor, part.mismatch)),
            part.text,
            "yes" if part.compatible else "no",
        )
        for name, part in terms.items()
    ]
    heads = ("policy", "rate", "error", "floor", "mismatch", "cross term", "may be zero")
    return tables.table_tables(title, heads, rows, _CAPTION)


def _verdict(terms: dict[str, CrossTerm]) -> str:
    name, part = worst(terms)
    if part.compatible:
        return "no cross term is told from zero: mismatch may stand for the error here"
    return (
        f"the cross term is {part.text} of the error under {name}: train with error: excess, "
        "or with a filter for the measurements under which it is none"
    )


_CAPTION = (
    "error = floor + mismatch + cross term, per step, in the reward's weights with mean 1; "
    "the cross term as a share of the error, with intervals that hold together in 95 %"
)
