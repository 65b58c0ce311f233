r"""Say how rarely the sensors of a log may report, and what to type into them.

    fusion-gym field mast --exact --target-rate 0.05

The first part of the log determines a plant. Rules are tuned and an agent is trained on the plant
with resampled residuals, and measured on the rest of the log. The report compares them at equal
packets with what devices run, report on change with held values. It ends in ``reportable_change``,
``min_interval`` and ``max_interval`` for each sensor.

The output folder contains ``report.html``, ``report.md``, two pictures, the option file
``plant.yaml`` and the recommended ``devices.yaml``.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import joblib
import numpy as np
import tyro

from fusion_gym.commands.command_line import Long
from fusion_gym.commands.fit import plant_text
from fusion_gym.commands.options import OUTPUT_FOLDER, between, whole
from fusion_gym.entries import Options, Plain
from fusion_gym.evaluation.field_study import (
    ENV,
    METHODS,
    FieldStudy,
    MethodPoint,
    at_rate,
    compare_with_practice,
    measure,
    point_at,
    simulate_sizes,
)
from fusion_gym.output.field_report import FieldReport, draw_card, draw_curves, write_report
from fusion_gym.output.files import (
    check_inputs,
    folder_refusal,
    lock_folder,
    read_json,
    write,
    write_text,
)
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.recordings import Recording, fit
from fusion_gym.recordings.fitting import criticise, deviations, noisy_channels, warnings_of
from fusion_gym.recordings.recording import SHIPPED
from fusion_gym.training.algorithms import settings
from fusion_gym.training.config import (
    EnvironmentConfig,
    Experiment,
    TrainingConfig,
    ValidationConfig,
)
from fusion_gym.training.run import holds_training, train
from fusion_gym.validation import ConfigurationError

AGENT = "agent"
_WINDOWS, _LONGEST, _SHORTEST = 60, 300, 20  # windows at least, and steps of a window
_PRICES = 4.0  # ratio of the highest to the middle price of the agent
_COMPLETE = 0.5  # of the steps, whose residuals can be resampled


@dataclass(frozen=True)
class Field(Long):
    """Say how rarely the sensors of a log may report, and what to type into them."""

    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The CSV file, or mast or tanks; fusion-gym info shows its data card."""
    target_rate: Annotated[float, between(0.0, 0.5)] = 0.05
    """Packets a sensor and step at which rules are compared."""
    output: Annotated[Path, OUTPUT_FOLDER] = Path("runs/field")
    """Folder of the report."""
    channels: tuple[str, ...] = ()
    """Channels by name; by default all without a fault."""
    share: Annotated[float, between(0.0, 0.95)] = 0.5
    """Share of the log, from its start, for the fit."""
    exact: bool = False
    """The readings are the truth: fit no measurement noise."""
    timesteps: Annotated[int, whole(1, 10**9)] = 200_000
    """Steps of the agent's training."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""
    resume: bool = False
    """Continue with the methods that the folder lacks."""

    def run(self) -> None:
        """Fit, tune, train, measure and report."""
        whole = Recording.read(self.log)
        recording = whole.select(self.channels)
        inputs: Plain = {"log": joblib.hash(whole.values), "target_rate": self.target_rate}
        inputs |= {"share": self.share, "channels": self.channels, "exact": self.exact}
        place = self.output / "study.json"
        if place.exists() and not self.resume:
            raise folder_refusal(self.output, "a study")
        if place.exists():
            check_inputs(inputs, read_json(place, "output"), f"the study in {str(self.output)!r}")
        plant = fit(recording, self.share, self.exact, order=1)  # a hold has no lags
        if names := noisy_channels(plant):
            raise ConfigurationError(
                f"exact = False is not allowed with this log: {', '.join(names)} have measurement "
                "noise, so their readings are no truth; give --exact if they are"
            )
        log = self.log if self.log in SHIPPED else str(Path(self.log).absolute())
        values, rows = deviations(recording, self.share)
        complete = float(np.isfinite(values[:rows]).all(axis=1).mean())
        horizon = int(np.clip((len(values) - rows) // _WINDOWS, _SHORTEST, _LONGEST))
        study = FieldStudy(
            options=plant.options | {"log": log, "fit_share": self.share},
            rate=self.target_rate,
            shape=plant.typical_changes,
            horizon=horizon,
            source="resampled" if complete >= _COMPLETE else "normal",
        )  # fmt: skip
        study.task("joint", "recorded")  # refuses before anything is written
        criticism = criticise(plant, values[rows:])
        with lock_folder(self.output, "output"):
            writing(("the report", self.output / "report.html"))
            write(place, inputs)
            write_text(self.output / "plant.yaml", plant_text(plant, recording, self.log, rows))
            points = {
                name: [MethodPoint(**point) for point in read_json(path, "output")["points"]]
                for name, path in self.pieces(study)
            }
            draw_card(whole, self.output / "card.png")
            results = compare_with_practice(study, points)
            draw_curves(study, points, self.output / "curves.png")
            report = FieldReport(
                name=Path(self.log).name, whole=whole, recording=recording, study=study,
                rows=rows, criticism=criticism,
                warnings=(*plant.remarks, *warnings_of(plant, values[rows:], criticism)),
                points=points, results=results,
            )  # fmt: skip
            print(write_report(report, self.output))

    def pieces(self, study: FieldStudy) -> Iterator[tuple[str, Path]]:
        """Measure the methods that the folder lacks, and yield all with their files."""
        names = [*METHODS, AGENT]
        paths = {name: self.output / f"{name.replace(', ', '_').replace(' ', '_')}.json"
                 for name in names}  # fmt: skip
        lacking = sorted(
            (name for name, path in paths.items() if not path.exists()),
            key=lambda name: name != AGENT and not METHODS[name][1],
        )
        calls = (
            joblib.delayed(_measure)(study, name, paths[name], self.output, self.timesteps)
            for name in lacking
        )
        with progress_bar(len(names), "methods", len(names) - len(lacking), unit="methods") as bar:
            parallel = joblib.Parallel(self.workers, return_as="generator_unordered", batch_size=1)
            for name in parallel(calls):
                bar.say(name)
                bar.update()
        yield from paths.items()


def _measure(study: FieldStudy, name: str, path: Path, folder: Path, timesteps: int) -> str:
    """Measure one method, and write its points."""
    own = name == AGENT
    points = train_agent(study, folder / "agent", timesteps) if own else measure(study, name)
    write(path, {"points": [asdict(point) for point in points]})
    return name


def train_agent(study: FieldStudy, folder: Path, timesteps: int) -> list[MethodPoint]:
    """Train a centralised scheduler, and measure it at five prices."""
    few, many = (
        simulate_sizes(study, "centralised", at_rate(study, "centralised", np.ones(1), factor))
        for factor in (0.7 * study.rate, 1.4 * study.rate)
    )
    middle = (few[0] - many[0]) / (many[1] - few[1]) / len(study.shape)
    prices = [float(f"{middle * factor:.4g}") for factor in np.geomspace(1 / _PRICES, _PRICES, 5)]
    drawn: Options = {"cost_weight": "random", "price_range": [prices[0], prices[-1]]}
    free = {"tokens": "unlimited", "token_cost": 1.0, "horizon": study.horizon, "filter": "joint",
            "reward_scale": 1.0}  # fmt: skip
    options = {**study.options, **free, **drawn, "source": study.source}
    experiment = Experiment(
        environment=EnvironmentConfig(id=ENV, options=json.loads(json.dumps(options))),
        algorithm=settings({"name": "counterfactual_ppo", "n_steps": 8, "gamma": 0.99}),
        training=TrainingConfig(timesteps=timesteps, num_envs=256, price_exponent=0.8),
        validation=ValidationConfig(every=max(timesteps // 3, 1), episodes=64),
        output=str(folder),
    )
    if not train(experiment, resume=holds_training(folder), quiet=True)["finished"]:
        raise KeyboardInterrupt
    rule, priced = f"model:{folder / 'best_model.zip'}", {**drawn, "reward_scale": 1.0}
    return [
        point_at(study, [price], "joint", priced, f"{rule},price={price!r}") for price in prices
    ]
