"""Train agents in the solved case and print what they cost above the optimum.

    python -m fusion_gym.agents.maintenance solved --seeds 0 1 2

Trainings go into ``runs/solved``; a finished one is not repeated, an interrupted one is gone on
with. Costs are compared on the same test seeds, paired.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

from ..command_line import Long
from ..experiments.verdict import excess
from ..input.options import Episodes, OutputFolder, Seed, TrainingSeeds
from ..output import tables
from ..output.files import read_json, write
from ..output.folders import fingerprint
from ..output.progress import progress_bar, writing
from ..training.checked import load_checked
from ..training.config import Experiment
from ..training.run import holds_training, train


@dataclass(frozen=True)
class Solved(Long):
    """Train agents in the solved case and print what they cost above the optimum."""

    config: str = "remote_estimation_ppo"
    """The training: a YAML file, or the name of a shipped config."""
    seeds: TrainingSeeds = (0, 1, 2)
    """Seeds of the trainings."""
    episodes: Episodes = 4000
    """Test episodes of each policy."""
    seed: Seed = 0
    """Seed of the first test episode."""
    output: Annotated[Path, OutputFolder()] = Path("runs/solved")
    """Folder for the results."""

    def run(self) -> None:
        """Train what is not trained, run all on the same seeds, write and print the costs."""
        experiment = load_checked(Experiment, self.config)
        name, environment = experiment.algorithm.name, experiment.environment
        task = make_task(environment.id, **environment.options)
        task.system.nature.refuse("for the solved optimum")
        best = self._tested(task, "optimal", "testing the optimum")
        if best.returns.mean() == 0.0:
            raise ConfigurationError(
                f"config {self.config!r} is not allowed: its optimum costs nothing, so nothing can "
                "be compared with it"
            )
        writing(("trainings and costs", self.output))
        heads = ("policy", "cost of an episode", "rate", "above the optimum [95 %]")
        table = tables.table_tables(f"{self.config}: {self.episodes} episodes", heads)
        report: dict[str, Any] = {"config": self.config, "agents": {}}
        table.add_row("optimal", f"{-best.returns.mean():.4f}", f"{best.rate.mean():.4f}", "")
        for seed in self.seeds:
            model = trained(experiment, seed, self.output)
            agent = self._tested(task, f"model:{model}", f"testing training seed {seed}")
            result = excess(agent.returns, best.returns)
            report["agents"][str(seed)] = result
            write(self.output / f"{name}.json", report)
            table.add_row(
                f"{name}, training seed {seed}",
                f"{-agent.returns.mean():.4f}",
                f"{agent.rate.mean():.4f}",
                f"{result['mean']:+.2%} [{result['low']:+.2%}, {result['high']:+.2%}]",
            )
        tables.console().print(table)

    def _tested(self, task: Task, name: str, description: str) -> EpisodeResults:
        policy = make_policy(name, task)
        with progress_bar(self.episodes * task.horizon, description) as bar:
            return run_episodes(task, policy, self.episodes, self.seed, bar.update)


def trained(experiment: Experiment, seed: int, folder: Path) -> Path:
    """The final model of a training seed, trained as far as it is not.

    Raises:
        ConfigurationError: the folder holds another training.
        KeyboardInterrupt: the training was interrupted.
    """
    output = folder / f"{experiment.algorithm.name}_{seed}"
    choice = experiment.changed(output, seed=seed)
    if not is_finished(choice) and not train(choice, resume=holds_training(output))["finished"]:
        raise KeyboardInterrupt
    return output / "final_model.zip"


def is_finished(experiment: Experiment) -> bool:
    """Whether this very training has been finished in its folder."""
    folder = Path(experiment.output)
    try:
        summary = read_json(folder / "summary.json", "output")
    except ConfigurationError:  # the training writes it anew
        return False
    same = summary.get("inputs") == fingerprint(experiment.inputs())
    return same and summary.get("finished") is True and (folder / "final_model.zip").is_file()
