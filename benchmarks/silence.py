"""Compare what devices run with filters that use silence, at equal rates, for docs/silence.md.

    python -m benchmarks.silence [--episodes 1000] [--resume]

Thresholds have the ratios of the sensors' changes in ten steps. Their scale is searched for each
rate on 150 episodes, and 1,000 other episodes measure it. ``tuned`` improves the threshold of one
sensor after another at the same rate. ``--resume`` keeps the plants in runs/silence.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import tyro
from rich.progress import track

import fusion_gym
from benchmarks.throughput import replaced
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.docstrings import table
from fusion_gym.entries import Options
from fusion_gym.evaluation import run_episodes, summarise
from fusion_gym.output.figures import plain_tick, save_figure
from fusion_gym.output.files import write

PAGE = Path(__file__).parent.parent / "docs" / "silence.md"
RATES = 0.02, 0.05, 0.1, 0.2, 0.3
_NEXT = np.roll(np.eye(6), 1, axis=1)
PLANTS: dict[str, Options] = {
    "default": {},
    "ring": {  # six states that exchange heat with their neighbours
        "transition": (0.9 * np.eye(6) + 0.04 * (_NEXT + _NEXT.T)).tolist(),
        "process_covariance": (0.05 * np.eye(6)).tolist(),
        "measurement_matrices": np.eye(6).tolist(),
        "measurement_covariances": [0.02, 0.02, 0.05, 0.05, 0.1, 0.1],
    },
    "rooms": {  # three temperatures, each measured twice
        "transition": [[0.98, 0.01, 0.0], [0.01, 0.97, 0.01], [0.0, 0.01, 0.98]],
        "process_covariance": np.diag([0.04, 0.01, 0.04]).tolist(),
        "measurement_matrices": np.repeat(np.eye(3), 2, axis=0).tolist(),
        "measurement_covariances": [0.02, 0.1, 0.02, 0.1, 0.02, 0.1],
    },
}
Method = Callable[[Array], tuple[Options, str]]


def delta(thresholds: Array, kind: str) -> tuple[Options, str]:
    """Return the options of a filter, and send-on-delta with a threshold for each sensor."""
    options: Options = {"filter": kind}
    if kind == "truncated":
        options |= {"trigger": "send_on_delta", "trigger_threshold": thresholds.tolist()}
    return options, f"send_on_delta:threshold={'/'.join(map(repr, thresholds.tolist()))}"


METHODS: dict[str, Method] = {
    "hold": partial(delta, kind="hold"),
    "ignoring": partial(delta, kind="kalman"),
    "truncated": partial(delta, kind="truncated"),
    "tuned": partial(delta, kind="truncated"),
    "stochastic": lambda scales: (
        {"filter": "stochastic", "stochastic_weight": (scales**-2.0).tolist()},
        "stochastic_event",
    ),
    "value of information": lambda scales: (
        {},
        f"value_of_information:threshold={float(scales[0]) ** 2!r}",
    ),
}


def changes(plant: Options) -> Array:
    """Return the deviations (sensors,) of what the measurements change in ten steps."""
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", tokens="unlimited", **plant)
    batch = EpisodeBatch.seeded(task, 1000, 0)
    first = batch.state.estimate.measurement
    for _ in range(10):
        batch.step(np.zeros((task.sensors, 1000), dtype=np.bool_))
    result: Array = (batch.state.estimate.measurement - first).std(-1)[:, 0]
    return result


def run(plant: Options, method: Method, scales: Array, episodes: int, seed: int) -> Any:
    """Return the metrics of a method."""
    options, rule = method(scales)
    options = {"tokens": "unlimited", "reward_scale": None} | plant | options
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", **options)
    return summarise(run_episodes(task, fusion_gym.make_policy(rule, task), episodes, seed))


def at_rate(plant: Options, method: Method, shape: Array, rate: float) -> tuple[Array, float]:
    """Return the scales of this shape at the rate, and their mean squared error."""
    low, high = np.log([0.02, 50.0])
    for _ in range(9):
        middle = 0.5 * (low + high)
        result = run(plant, method, np.exp(middle) * shape, 150, 10**6)
        if np.mean(result["rate"]) > rate:
            low = middle
        else:
            high = middle
    return np.exp(middle) * shape, result["mse"]["mean"]


def tune(plant: Options, method: Method, shape: Array, rate: float) -> Array:
    """Return one threshold per sensor, each changed by a factor while the error falls."""
    best, error = at_rate(plant, method, shape, rate)
    for sensor in range(len(shape)):
        for change in (1.5, 1.0 / 1.5):
            trial = best.copy()
            trial[sensor] *= change
            scales, value = at_rate(plant, method, trial, rate)
            if value < error:
                best, error = scales, value
    return best


def measure(name: str, episodes: int) -> dict[str, list[Any]]:
    """Return the metrics of each method at each rate."""
    plant, results = PLANTS[name], {}
    shape = changes(plant)
    for label, method in track(METHODS.items(), name):
        search = tune if label == "tuned" else lambda *values: at_rate(*values)[0]
        scales = [search(plant, method, shape, rate) for rate in RATES]
        results[label] = [run(plant, method, own, episodes, 0) for own in scales]
    return results


def main(episodes: int = 1000, resume: bool = False, folder: Path = Path("runs/silence")) -> None:
    """Measure the plants, and write tables and picture.

    Args:
        episodes: of each method and rate.
        resume: keep measured plants.
        folder: of measured plants.
    """
    text, (figure, panels) = PAGE.read_text(encoding="utf-8"), plt.subplots(1, 3, figsize=(12, 4))
    for name, panel in zip(PLANTS, panels, strict=True):
        path, rows = folder / f"{name}.json", []
        if not (resume and path.exists()):
            write(path, measure(name, episodes))
        for label, results in json.loads(path.read_text()).items():
            rows.append((label, *(_cell(result) for result in results)))
            errors = [result["mse"]["mean"] for result in results]
            panel.loglog([np.mean(result["rate"]) for result in results], errors, "o-", label=label)
        heads = "MSE (NEES) at the rate", *map(str, RATES)
        content = f"{table(heads, rows)}\n\nMeasured in fusion-gym {fusion_gym.__version__}."
        text = replaced(text, name, content)
        panel.set_xticks(RATES, map(str, RATES))
        panel.xaxis.set_minor_formatter("")
        panel.yaxis.set(major_formatter=plain_tick, minor_formatter=plain_tick)
        panel.set(title=name, xlabel="packets per sensor and step", ylabel="mean squared error")
    panels[0].legend(fontsize=8)
    figure.tight_layout()
    save_figure(figure, PAGE.with_name("silence.png"))
    PAGE.write_text(text, encoding="utf-8")


def _cell(result: Any) -> str:
    mse = result["mse"]
    half = (mse["high"] - mse["low"]) / 2.0
    return f"{mse['mean']:.3g} ± {half:.1g} ({result['nees']['mean']:.2f})"


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
