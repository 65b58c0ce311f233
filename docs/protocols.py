"""Draw the picture of the page on networks: ``python -m docs.protocols``."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import make_task

_STEPS, _RATE = 14, 0.5
_LOSSY = {"channel": "independent", "drop_probability": 0.4}
PROTOCOLS: dict[str, dict[str, Any]] = {
    'access="any"': {},
    'access="single"': {"access": "single"},
    'access="round_robin"': {"access": "round_robin"},
    'access="random"': {"access": "random"},
    'access="slots", slots=2': {"access": "slots", "slots": 2},
    'access="try_once_discard"': {"access": "try_once_discard"},
    'access="collision"': {"access": "collision"},
    'access="collision", channels=2': {"access": "collision", "channels": 2},
    'channel="independent"': _LOSSY,
    'channel="gilbert_elliott"': {"channel": "gilbert_elliott"},
    "delay=2": {"delay": 2},
    "delay=(0, 4)": {"delay": (0, 4)},
}


def draw(axes: Any, options: dict[str, Any]) -> None:
    """Draw the fate of random requests of three sensors."""
    every = {"tokens": "unlimited"} | options
    task = make_task("fusion_gym/CorrelatedTracking-v1", **every)
    batch = EpisodeBatch.seeded(task, 1, 3)
    drawn = np.random.default_rng(2).random((_STEPS, task.sensors)) < _RATE
    for step, request in enumerate(drawn):
        network, outcome = batch.state.network, batch.step(request[:, None])
        for sensor in np.flatnonzero(request):
            granted, arrived = outcome.granted[sensor, 0], outcome.arrived[sensor, 0]
            colour = "black" if granted else "0.7"
            late = 0 if network.draws.delay is None else int(network.draws.delay[sensor, 0])
            marker = "x" if granted and not (arrived or late) else "o"
            face = colour if granted and marker == "o" else "none"
            style = {"ec": colour} if marker == "o" else {}
            axes.scatter(step, sensor, 22, fc=face if style else colour, marker=marker, **style)
            if granted and late:
                axes.plot([step, step + late], [sensor, sensor - 0.3], "0.5", lw=0.8)


def main() -> None:
    """Write the picture."""
    figure, axes = plt.subplots(-(-len(PROTOCOLS) // 3), 3, figsize=(9.6, 6.4), sharex=True)
    for place in axes.flat[len(PROTOCOLS) :]:
        place.remove()
    for place, (name, options) in zip(axes.flat, PROTOCOLS.items(), strict=False):
        draw(place, options)
        place.set_title(name, fontsize=9, family="monospace")
        place.set(yticks=range(3), ylim=(-0.6, 2.6), xlim=(-0.6, _STEPS + 3))
        place.tick_params(labelsize=7)
    figure.supxlabel("step", fontsize=9)
    figure.supylabel("sensor", fontsize=9)
    figure.tight_layout()
    figure.savefig(Path(__file__).with_name("networks.png"), dpi=110)


if __name__ == "__main__":
    main()
