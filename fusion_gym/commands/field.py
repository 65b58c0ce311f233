r"""Say how rarely the sensors of a log may report, and what to type into them.

    fusion-gym field mast --exact --target-rate 0.05
    fusion-gym field mast --exact --tolerance 0.5 --device zigbee

The first part of the log determines a plant. Rules are tuned and an agent is trained on the plant
with resampled residuals, and measured on the rest of the log. The report compares them at equal
packets with what devices run, report on change with held values. With ``--tolerance`` it
compares the least packets that keep your root mean square errors. It ends in ``reportable_change``,
``min_interval`` and ``max_interval`` for each sensor.

The output folder contains ``report.html``, ``report.md``, two pictures, the option file
``plant.yaml`` and the recommended ``devices.yaml``.
"""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
import tyro

from fusion_gym.commands.command_line import OUTPUT_FOLDER, Long, between, whole
from fusion_gym.commands.fit import FitOptions, plant_text, warn
from fusion_gym.entries import Options, Plain
from fusion_gym.errors import forbidden
from fusion_gym.output import files
from fusion_gym.output.ending import ended_like_by_ctrl_c
from fusion_gym.output.progress import progress_bar, writing
from fusion_gym.policies.registry import parse_settings, parse_value
from fusion_gym.recordings import DeviceName
from fusion_gym.training.run import holds_training, train
from fusion_gym.validation import number, refusal

if TYPE_CHECKING:
    from fusion_gym.recordings.field_study import FieldStudy, MethodPoint, Work
    from fusion_gym.training.config import Experiment

AGENT = "agent"
_WINDOWS, _LONGEST, _SHORTEST = 60, 300, 20  # windows at least, and steps of a window
_PRICES = 4.0  # ratio of the highest to the middle price of the agent
_RATE, _START = 0.05, 1e-3  # target rate by default, and least rate of a tolerance
_TRAINING = 5  # steps of the training in the time of one step of a trial, about
_STAGES = {"run_trial": "tuning", "train_model": "training", "point_at": "measurement",
           "replay_whole": "replay of the whole part"}  # fmt: skip
_COMPLETE = 0.5  # of the steps, whose residuals can be resampled


@dataclass(frozen=True)
class Field(FitOptions, Long):
    """Say how rarely the sensors of a log may report, and what to type into them."""

    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """The CSV file, or mast or tanks; fusion-gym info shows its data card."""
    target_rate: Annotated[float | None, between(0.0, 0.5)] = None
    """Packets a sensor and step at which rules are compared; 0.05 without --tolerance."""
    tolerance: tuple[str, ...] = ()
    """Root mean square error that is allowed, in a channel's unit: a number for all channels, a
    number for each, or NAME=NUMBER for each."""
    device: DeviceName | None = None
    """Device whose fields take the settings; its steps and limits hold in the study."""
    output: Annotated[Path, OUTPUT_FOLDER] = Path("runs/field")
    """Folder of the report."""
    timesteps: Annotated[int, whole(1, 10**9)] = 200_000
    """Steps of the agent's training."""
    workers: Annotated[int, whole(1, 512)] = 2
    """Number of parallel processes."""
    resume: bool = False
    """Continue with the methods that the folder lacks."""

    def run(self) -> None:
        """Fit, tune, train, measure and report."""
        # Imported here, because pandas and matplotlib take a second to load.
        import joblib

        from fusion_gym.recordings import Recording, field_report, field_study, fit, fitting
        from fusion_gym.recordings.field_report import FieldReport
        from fusion_gym.recordings.field_study import HELD, FieldStudy, MethodPoint, scale
        from fusion_gym.recordings.recording import SHIPPED

        whole = Recording.read(self.log, **self.reading)
        recording = self.select(whole)
        if self.tolerance and self.target_rate is not None:
            raise forbidden("target_rate", self.target_rate, "--tolerance determines the rate")
        rate = _START if self.tolerance else self.target_rate or _RATE
        names = [channel.name for channel in recording.channels]
        tolerance = tolerances(self.tolerance, names) if self.tolerance else ()
        seconds = recording.interval.total_seconds()
        longest = field_report.longest_interval(self.device, seconds)
        inputs: Plain = {"log": joblib.hash(whole.values), "device": self.device}
        inputs |= {"tolerance": tolerance} if tolerance else {"target_rate": rate}
        inputs |= {"share": self.share, "channels": self.channels, "exact": self.exact}
        inputs |= {"on_change": self.on_change, "units": [c.unit for c in recording.channels]}
        place = self.output / "study.json"
        if place.exists() and not self.resume:
            raise files.folder_refusal(self.output, "a study")
        if place.exists():
            before = files.read_json(place, "output")
            files.check_inputs(inputs, before, f"the study in {str(self.output)!r}")
        plant = fit(recording, self.share, self.exact, order=1)  # a hold has no lags
        values, rows = fitting.deviations(recording, self.share)
        complete = float(np.isfinite(values[:rows]).all(axis=1).mean())
        horizon = int(np.clip((len(values) - rows) // _WINDOWS, _SHORTEST, _LONGEST))
        study = FieldStudy(
            options=plant.options | {"fit_share": self.share}, rate=rate,
            shape=tolerance or plant.typical_changes, horizon=horizon,
            source="resampled" if complete >= _COMPLETE else "normal", tolerance=tolerance,
            steps=tuple(field_report.step_of(self.device, c.unit) for c in recording.channels),
            lengths=(rows, len(values) - rows), longest=longest, trials=self.output / "trials",
        )  # fmt: skip
        log = self.log if self.log in SHIPPED else str(Path(self.log).absolute())
        copy = None
        if self.on_change or any(self.reading.values()):  # the study reads without options
            copy = recording if self.on_change else whole
            log = str(self.output.absolute() / "log.csv")
        with TemporaryDirectory() as folder:  # refuses before anything is written
            if copy is not None:
                copy.write(Path(folder) / "log.csv")
            study.task("joint", "recorded", log=log if copy is None else f"{folder}/log.csv")
        study = replace(study, options={**study.options, "log": log})
        criticism = fitting.criticise(plant, values[rows:])
        warnings = [*recording.remarks, *plant.remarks]
        warnings += fitting.warnings_of(plant, values[rows:], criticism)
        if self.device == "zigbee":
            warnings += [
                f"{c.name}: zigbee has no step for the unit {c.unit!r}; give --unit {c.name}=°C"
                for c in recording.channels
                if c.unit not in field_report.ATTRIBUTES
            ]
        warn(warnings)
        with files.lock_folder(self.output, "output"):
            writing(("the report", self.output / "report.html"))
            if copy is not None:
                copy.write(log)
            files.write(place, inputs)
            text = plant_text(plant, recording, self.log, rows)
            files.write_text(self.output / "plant.yaml", text)
            with ended_like_by_ctrl_c():
                if tolerance:
                    sizes = scale(study, HELD, np.array(study.shape))
                    rate = study.call(field_study.run_trial, HELD, sizes, study.source).rate
                    study = replace(study, rate=max(rate, _START))
                paths = self.measure_methods(study)
            read = {name: files.read_json(path, "output") for name, path in paths.items()}
            points = {name: [MethodPoint(**p) for p in own["points"]] for name, own in read.items()}
            field_report.draw_card(whole, self.output / "card.png")
            results = [] if tolerance else field_study.compare_with_held(study, points)
            field_report.draw_curves(study, points, self.output / "curves.png")
            report = FieldReport(
                name=Path(self.log).name, whole=whole, recording=recording, study=study,
                rows=rows, criticism=criticism, warnings=warnings,
                points=points, results=results, device=self.device,
            )  # fmt: skip
            print(field_report.write_report(report, self.output))
            shutil.rmtree(self.output / "trials", ignore_errors=True)

    def measure_methods(self, study: "FieldStudy") -> dict[str, Path]:
        """Measure the methods that the folder lacks, and return the files of all."""
        import joblib

        from fusion_gym.recordings import field_study
        from fusion_gym.recordings.field_study import METHODS

        names = sorted([*METHODS, AGENT], key=lambda name: name != AGENT and not METHODS[name][1])
        paths = {name: self.output / f"{name.replace(', ', '_').replace(' ', '_')}.json"
                 for name in [*METHODS, AGENT]}  # fmt: skip
        calls = (joblib.delayed(_measure)(study, name, paths[name], self.output, self.timesteps)
                 for name in names if not paths[name].exists())  # fmt: skip
        work = {name: field_study.work(study, name) for name in names}
        work[AGENT]["train_model"] = 1, self.timesteps // _TRAINING
        total, over = sum(n * steps for own in work.values() for n, steps in own.values()), Event()
        workers = joblib.Parallel(self.workers, return_as="generator_unordered", batch_size=1)
        with progress_bar(total, "methods", _progress(study, paths, work)[0], most=20.0) as bar:

            def watch() -> None:
                while not over.wait(1.0):
                    done, stages = _progress(study, paths, work)
                    bar.reach(done)
                    bar.say(stages)

            Thread(target=watch, daemon=True).start()
            try:
                list(workers(calls))
            finally:
                over.set()
            bar.say("")
            bar.reach(total)
        return paths


def tolerances(words: Sequence[str], names: Sequence[str]) -> tuple[float, ...]:
    """Return the tolerance of each channel, from one number, one for each, or NAME=NUMBER."""
    values = [parse_value(word) for word in words]
    named = dict(zip(names, values * len(names) if len(values) == 1 else values, strict=False))
    if any("=" in word for word in words):
        named = parse_settings("tolerance", words)
    if set(named) != set(names) or len(words) > len(names):
        allowed = f"one number, or one for each of the channels {', '.join(names)}"
        raise refusal("tolerance", list(words), allowed)
    return tuple(number("tolerance", named[name], above=0.0) for name in names)


def _progress(
    study: "FieldStudy", paths: Mapping[str, Path], work: Mapping[str, "Work"]
) -> tuple[int, str]:
    """Return the simulated steps that the folder holds, and the present stage of each method."""
    done, stages = 0, []
    for name, own in work.items():
        trials, stage = cast(Path, study.trials) / paths[name].stem, ""
        ended = paths[name].exists()
        for function in reversed([stage for stage in _STAGES if stage in own]):
            calls, steps = own[function]
            held = len(list(trials.rglob(f"{function}/*/output.pkl")))
            done += steps * (calls if ended else min(held, calls))
            stage = stage if ended or held >= calls else _STAGES[function]
            ended = ended or held > 0  # the stages before have ended, too
        stages += [f"{name}: {stage}"] if stage and trials.exists() else []
    return done, "; ".join(stages)


def _measure(study: "FieldStudy", name: str, path: Path, folder: Path, timesteps: int) -> str:
    """Measure one method, and write its points."""
    from fusion_gym.recordings import field_study

    own, study = name == AGENT, replace(study, trials=cast(Path, study.trials) / path.stem)
    points = (
        train_agent(study, folder / "agent", timesteps) if own else field_study.measure(study, name)
    )
    files.write(path, {"points": [asdict(point) for point in points]})
    return name


def train_agent(study: "FieldStudy", folder: Path, timesteps: int) -> "list[MethodPoint]":
    """Train a centralised scheduler, and measure it at five prices."""
    from fusion_gym.recordings import field_study
    from fusion_gym.recordings.field_study import scale
    from fusion_gym.training.config import Experiment

    free = replace(study, tolerance=())
    sizes = (scale(free, "centralised", np.ones(1), factor) for factor in (0.7, 1.4))
    few, many = (
        study.call(field_study.run_trial, "centralised", own, study.source) for own in sizes
    )
    middle = (few.error - many.error) / (many.rate - few.rate) / len(study.shape)
    prices = [float(f"{middle * factor:.4g}") for factor in np.geomspace(1 / _PRICES, _PRICES, 5)]
    drawn: Options = {"cost_weight": "random", "price_range": [prices[0], prices[-1]]}
    fixed = {"tokens": "unlimited", "token_cost": 1.0, "horizon": study.horizon,
             "filter": "joint", "reward_scale": 1.0}  # fmt: skip
    options = {**study.options, **fixed, **drawn, "source": study.source}
    experiment = Experiment.model_validate({
        "environment": {"id": field_study.ENV, "options": json.loads(json.dumps(options))},
        "algorithm": {"name": "counterfactual_ppo", "n_steps": 8, "gamma": 0.99},
        "training": {"timesteps": timesteps, "num_envs": 256, "price_exponent": 0.8},
        "validation": {"every": max(timesteps // 3, 1), "episodes": 64},
        "output": str(folder),
    })  # fmt: skip
    study.call(train_model, experiment, folder)
    rule, priced = f"model:{folder / 'best_model.zip'}", {**drawn, "reward_scale": 1.0}
    rules = [([price], "joint", priced, f"{rule},price={price!r}") for price in prices]
    return field_study.measured(study, rules, None if study.tolerance else len(rules) // 2)


def train_model(study: "FieldStudy", experiment: "Experiment", folder: Path) -> None:
    """Train the model of an experiment in a folder, or continue its training."""
    if not train(experiment, resume=holds_training(folder), quiet=True)["finished"]:
        raise KeyboardInterrupt
