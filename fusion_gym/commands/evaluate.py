r"""Evaluate policies on paired episodes.

    fusion-gym evaluate --env fusion_gym/TobitOscillator-v1 --set filter=tobit \
        --policies always dynamic_event innovation_threshold:threshold=1 \
        --reference always

Every policy runs on the same seeds, so all policies meet the same noise. The command writes the
JSON after each policy; with ``--resume`` it skips the policies that the JSON already contains.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from fusion_gym.commands.command_line import (
    EnvironmentOptions,
    Episodes,
    Long,
    OutputFile,
    PolicyNames,
    Seed,
)
from fusion_gym.core.task import Task
from fusion_gym.entries import Arguments, Plain
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation import metrics
from fusion_gym.evaluation.episodes import BATCH, EpisodeResults, run_episodes, run_several
from fusion_gym.output import tables
from fusion_gym.output.files import check_inputs, read_json, write
from fusion_gym.output.progress import progress_bar, remark, writing
from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError, refusal

_INPUTS = "env", "episodes", "seed", "horizon", "settings"
_DRAWN = 100  # episodes of the comparison of drawn with likeliest actions


@dataclass(frozen=True)
class Evaluate(EnvironmentOptions, Long):
    """Evaluate policies on paired episodes."""

    policies: PolicyNames
    """Rules and references by name, zoo:NAME, or model:PATH."""
    episodes: Episodes = 1000
    """Episodes of each policy."""
    seed: Seed = 0
    """Seed of the first episode."""
    reference: str | None = None
    """One of the policies; print paired differences to it."""
    json: Annotated[Path | None, OutputFile(".json")] = None
    """Write the results to this file."""
    resume: bool = False
    """Skip the policies that the JSON already contains."""

    def run(self) -> None:
        """Evaluate the policies and print the tables."""
        env_id, options = self.environment()
        task = make_task(env_id, **options)
        names = list(dict.fromkeys(chain(*self.policies)))
        if not names:
            raise ConfigurationError("policies = [] is not allowed: give --policies NAME …")
        if self.reference is not None and self.reference not in names:
            raise refusal("reference", self.reference, f"one of the policies {names}")
        if self.resume and self.reference:
            raise ConfigurationError(
                f"resume = True is not allowed with reference = {self.reference!r}: paired "
                "differences need the episodes of every policy, and the JSON holds only their means"
            )
        policies = {name: make_policy(name, task) for name in names}
        report = evaluation_report(env_id, task, self.episodes, self.seed, {})
        done = finished(self.json, report) if self.resume else {"policies": {}}
        results: dict[str, EpisodeResults] = {}
        steps = self.episodes * task.horizon
        if self.json is None:
            remark("nothing is written (--json FILE keeps the results)")
        else:
            writing(("the results of each policy", self.json))
        earlier = steps * len(done["policies"].keys() & policies.keys())
        with progress_bar(len(names) * steps, "evaluating", earlier) as bar:
            for part in ("policies", "quantiles"):
                report[part] |= {n: done[part][n] for n in names if n in done["policies"]}
            rest = [name for name in names if name not in done["policies"]]
            size = max(1, BATCH // self.episodes)
            for some in (rest[first : first + size] for first in range(0, len(rest), size)):
                bar.say(some[0] if len(some) == 1 else f"{len(some)} policies")
                built = [policies[name] for name in some]
                every = run_several(task, built, self.episodes, self.seed, bar.update)
                for name, result in zip(some, every, strict=True):
                    results[name] = result
                    report["policies"][name] = metrics.summarise(result)
                    report["quantiles"][name] = metrics.robust_summary(result)
                    warn_of_draws(name, task, policies[name], result, self.seed)
                write(self.json, report)
        for part in ("policies", "quantiles"):  # in the order of the command line
            report[part] = {name: report[part][name] for name in names}
        differences = {
            name: metrics.paired_difference(result, results[self.reference])
            for name, result in results.items()
            if self.reference and name != self.reference
        }
        if self.reference:
            plain = {name: difference._asdict() for name, difference in differences.items()}
            report["reference"] = {"name": self.reference, "differences": plain}
        write(self.json, report)
        title = f"{env_id}: {self.episodes} episodes of {task.horizon} steps, seed {self.seed}"
        table = tables.evaluation_table(title, report["policies"], report["quantiles"], differences)
        tables.console().print(table)
        tables.console().print(tables.state_table(task.plant.state_names, report["policies"]))

    def interrupted(self) -> str:
        """Return how to resume; paired differences need a new evaluation."""
        if self.json is None:
            return "interrupted: nothing is saved (--json FILE saves finished policies)"
        if self.reference is not None:
            return f"interrupted: finished policies are in {self.json}; --reference begins again"
        return super().interrupted()


def warn_of_draws(
    name: str, task: Task, policy: Policy, results: EpisodeResults, seed: int
) -> None:
    """Print a remark if drawn actions change the return of an agent significantly."""
    if not getattr(policy, "deterministic", False):
        return
    drawn = make_policy(f"{name},deterministic=false", task)
    episodes = min(results.episodes, _DRAWN)
    returns = run_episodes(task, drawn, episodes, seed).returns
    difference = metrics.mean_interval(returns - results.returns[:episodes])
    if difference.low > 0.0 or difference.high < 0.0:
        remark(
            f"{name} takes its likeliest actions; drawn actions change the return by "
            f"{difference.mean:+.3g} [{difference.low:+.3g}, {difference.high:+.3g}] in {episodes} "
            f"episodes: {name},deterministic=false evaluates them"
        )


def evaluation_report(
    env_id: str, task: Task, episodes: int, seed: int, results: Mapping[str, EpisodeResults]
) -> Plain:
    """Return the JSON of an evaluation."""
    return {
        "env": env_id,
        "episodes": episodes,
        "seed": seed,
        "horizon": task.horizon,
        "settings": task.settings,
        "states": list(task.plant.state_names),
        "policies": {name: metrics.summarise(result) for name, result in results.items()},
        "quantiles": {name: metrics.robust_summary(result) for name, result in results.items()},
    }


def _evaluation() -> Any:
    """Return the model of the JSON of an evaluation."""
    # Imported here, because pydantic takes a tenth of a second to load.
    import pydantic

    row = Annotated[list[float], pydantic.Field(min_length=1)]  # an interval, or a list

    def kind(metric: metrics.Metric) -> tuple[Any, Any]:
        own: Any = row if metric.axis else metrics.Interval
        return (own | None, None) if metric.loop else (own, ...)

    columns: Arguments = {name: kind(metric) for name, metric in metrics.METRICS.items()}
    evaluated: Any = pydantic.create_model("EVALUATED", **columns)
    spread: Any = pydantic.create_model("Quantiles", median=(float, ...))

    class Evaluation(pydantic.BaseModel):
        policies: dict[str, evaluated]
        quantiles: dict[str, spread]

        @pydantic.model_validator(mode="after")
        def _paired(self) -> "Evaluation":
            if missing := sorted(self.policies.keys() - self.quantiles.keys()):
                raise ValueError(f"quantiles of {missing} are missing")
            return self

    return Evaluation


def finished(path: Path | None, report: Plain) -> Plain:
    """Return the JSON of an earlier run of the same evaluation."""
    from fusion_gym.training.config import checked

    if path is None:
        raise ConfigurationError("resume = True is not allowed without json: there is no file")
    if not path.exists():
        return {"policies": {}}
    earlier = read_json(path, "json")
    now, then = ({key: item.get(key) for key in _INPUTS} for item in (report, earlier))
    check_inputs(now, then, f"json {str(path)!r}")
    checked(_evaluation(), earlier, f"json = {str(path)!r}")
    return earlier
