"""The cases of the conformance suite: every registered environment, and what changes its parts."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from own_system import OWN_ID

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import ENVIRONMENTS

TOBIT = "fusion_gym/TobitOscillator-v0"
CORRELATED = "fusion_gym/CorrelatedTracking-v0"
JUMP = "fusion_gym/MarkovJumpTracking-v0"
INPUT = "fusion_gym/UnknownInput-v0"
BIASED = "fusion_gym/BiasedOscillator-v0"
TRACKING = "fusion_gym/BiasedTracking-v0"
LINEAR = "fusion_gym/LinearFusion-v0"
REMOTE = "fusion_gym/RemoteEstimation-v0"
IDS = [name for name in ENVIRONMENTS if name != OWN_ID] + [OWN_ID]

Options = dict[str, Any]
LIMITED: Options = {"tokens": "limited", "token_rate": 1.0, "initial_tokens": 5.0}
DRAWN: Options = {"cost_weight": "random", "price_range": (0.001, 1.0), "clock": True}
LOSSY: Options = {"sensors": 3, "channel": "gilbert_elliott", "coefficient": (0.9, 1.0, 1.02)}
GIVEN = np.sin(np.arange(41.0) / 3.0)[:, None].tolist()
STARVED: Options = {"bias_aware": False, "access": "round_robin", **LIMITED}
UNCENSORED: Options = {"filter": "kalman", "censoring_threshold": -np.inf, "random_start": True}
REMEMBERING: Options = {"memory": True}
ESTIMATES: Options = {"memory": True, "packet": "estimate"}
DEPARTED: Options = {"true_process_noise": (0.5, 2.0), "true_transition": (0.9, 1.1)}
NOISY: Options = DEPARTED | {"true_measurement_noise": 2.0}
UNALIKE: Options = {"token_cost": (1.0, 2.0, 4.0), "process_noise": "full", "sharing": "fixed"}

# Options that change what an environment is made of.
VARIANTS: dict[str, list[Options]] = {
    TOBIT: [
        {"filter": "tobit", "information": "centre", "action": "discrete"},
        {"filter": "adf", "access": "random"},
        {"filter": "stochastic", "stochastic_weight": 1.0, "fusion": "sici"},
        {"filter": "tobit", "fusion": "ci", "order": None, "access": "single"},
        {"filter": "tobit", "fusion": "sci", "access": "round_robin", **DRAWN},
        {"silent": "predict", "event_error": False, **UNALIKE},
        UNCENSORED,
        {"filter": "tobit", "measurement_matrices": (((1.0, 0.0),),)},
        {"filter": "tobit", "random_start": True} | REMEMBERING | LIMITED,
        REMEMBERING | {"belief_features": "value", "access": "single"} | DRAWN,
        {"filter": "tobit", "belief_features": "value", "action": "discrete"},
        UNCENSORED | ESTIMATES | {"belief_features": ("difference",), "action": "discrete"},
        {"filter": "tobit", "true_threshold_shift": (-1.0, 1.0)} | NOISY | REMEMBERING,
    ],
    CORRELATED: [
        {"fusion": "sci", "order": (2, 0, 1), "information": "centre", **LIMITED},
        {"fusion": "ci", "track_actual": True, "access": "random"},
        {"noise_scale": "random", "action": "discrete", "error": "trace", **DRAWN},
        {
            "fusion": "ici",
            "measurement_matrices": (((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),),
            "measurement_variance": ((0.6, 0.4),),
            "noise_coupling": 0.2,
            "trigger_threshold": 0.5,
            "trigger_offset": 0.2,
            "trigger_sensitivity": 0.9,
        },
        REMEMBERING | {"access": "round_robin", "noise_scale": "random"} | DRAWN,
        ESTIMATES | LIMITED,
        {"belief_features": ("difference", "value"), "broadcast": "packets", **LIMITED},
        {"noise_scale": "random"} | NOISY | REMEMBERING,
    ],
    JUMP: [
        {"fusion": "ci", "access": "single", **DRAWN},
        {"fusion": "sici", "information": "centre", "error": "trace", **LIMITED},
        {"filter": "centralised", "access": "round_robin"},
        {"filter": "imm"},
        {"filter": "imm", "information": "centre", "action": "discrete"},
        REMEMBERING | LIMITED,
        REMEMBERING | {"filter": "centralised", "memory_filter": "imm"},
        NOISY,
        REMEMBERING | {"filter": "imm"} | NOISY,
    ],
    INPUT: [
        {"filter": "predict", "fusion": "exact_ci", "access": "random", **DRAWN},
        {"filter": "paper", "input_signal": "steps", "information": "centre"},
        {"hold_variance": 0.1, "input_signal": "random_walk", "fusion": "sici", **LIMITED},
        {"example": "paper", "input_phase": "random", "action": "discrete", "error": "trace"},
        {"example": "paper", "input_signal": "steps", "filter": "random_walk", "fusion": "ici"},
        {"input_signal": GIVEN, "horizon": 40, "fusion": "sci"},
        REMEMBERING | {"filter": "predict"} | LIMITED,
        REMEMBERING | {"filter": "paper", "error": "trace"},
        REMEMBERING | NOISY,
    ],
    BIASED: [
        {"filter": "adf", "access": "any", "information": "centre"},
        {"filter": "kalman", "access": "random", "random_start": True, **DRAWN},
        STARVED,
        ESTIMATES | {"memory_filter": "kalman"},
        {"access": "any", "true_threshold_shift": 0.5} | NOISY | REMEMBERING,
    ],
    TRACKING: [
        {"filter": "stochastic", "stochastic_weight": 1.0, "access": "any", "fusion": "ici"},
        {"filter": "adf", "access": "round_robin", "error": "trace"},
        REMEMBERING | {"access": "round_robin"} | DRAWN,
    ],
    LINEAR: [
        {
            "measurement_matrices": [[1, 0], [[0, 1], [1, 1]], [1, -1]],
            "measurement_covariances": [0.3, [[0.2, 0.05], [0.05, 0.1]], 1.0],
            "fusion": "ci",
        }
        | REMEMBERING
        | DRAWN,
        {"censoring_threshold": (-2.0, -2.0), "access": "round_robin", "information": "centre"},
        ESTIMATES | NOISY | {"filter": "adf", "action": "discrete"},
        {
            "measurement_matrices": [[1, 0], [[0, 1], [1, 1]]],
            "joint_measurement_covariance": [[0.3, 0.2, 0.1], [0.2, 0.3, 0.1], [0.1, 0.1, 0.2]],
        }
        | REMEMBERING
        | LIMITED,
    ],
    REMOTE: [
        LOSSY | {"access": "single", "initial_deviation": 1.0} | DRAWN,
        {"sensors": 2, "channel": "independent", "action": "discrete", "error": "trace"},
        LOSSY | LIMITED | {"information": "centre"},
        LOSSY | REMEMBERING | DRAWN,
        LOSSY | REMEMBERING | DEPARTED | {"true_transition": (0.8, 0.95)},
    ],
    OWN_ID: [
        {"access": "random", **DRAWN},
        {"information": "centre", **LIMITED},
        REMEMBERING | LIMITED,
    ],
}


@dataclass(frozen=True)
class Case:
    """An environment with options; ``number`` counts those of one id, 0 is the default."""

    env_id: str
    number: int

    @property
    def options(self) -> Options:
        """The options that are not the environment's defaults."""
        return VARIANTS[self.env_id][self.number - 1] if self.number else {}

    @functools.cache  # noqa: B019  cases live as long as the tests
    def task(self, horizon: int | None = None, tokens: str | None = None) -> Task:
        """The task, with its own horizon and tokens or others."""
        other = {"horizon": horizon, "tokens": tokens}
        chosen = {name: value for name, value in other.items() if value is not None}
        return fusion_gym.make_task(self.env_id, **self.options | chosen)

    @property
    def not_local(self) -> str | None:
        """Why no sensor can decide by itself, as the message begins; ``None`` where one can."""
        for name, value in (("information", "centre"), ("packet", "estimate")):
            if self.options.get(name) == value:
                return f"{name} = {value!r}"
        return None

    def batch(
        self, seeds: list[int], horizon: int | None = None, owner: Owner | None = None
    ) -> EpisodeBatch:
        """Runs with these seeds, each at the start of an episode."""
        batch = EpisodeBatch(self.task(horizon), len(seeds), owner)
        batch.seed(np.arange(len(seeds)), seeds)
        batch.reset()
        return batch

    def __str__(self) -> str:
        words = [value for value in self.options.values() if isinstance(value, str)]
        words += ["memory"] * ("memory" in self.options)
        words += ["departed"] * any(name.startswith("true_") for name in self.options)
        return "-".join([self.env_id.partition("/")[2].removesuffix("-v0"), *words])


CASES = [Case(name, n) for name in IDS for n in range(1 + len(VARIANTS.get(name, ())))]
DEFAULTS = [case for case in CASES if not case.number]
LASTING = [case for case in CASES if not isinstance(case.options.get("input_signal"), list)]
each_case = pytest.mark.parametrize("case", CASES, ids=str)
each_default = pytest.mark.parametrize("case", DEFAULTS, ids=str)
each_lasting = pytest.mark.parametrize("case", LASTING, ids=str)  # of any horizon
each_id = pytest.mark.parametrize("env_id", IDS)


def requests(task: Task, runs: int, steps: int, rate: float = 0.4) -> NDArray[np.bool_]:
    """Random requests (steps, sensors, runs), always the same; one a step with single access."""
    wanted = np.random.default_rng(7).random((steps, task.sensors, runs)) < rate
    return wanted & (wanted.cumsum(1) == 1) if task.access == "single" else wanted


def actions(task: Task, wanted: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Actions (runs, …) of a coordinator for the requests (sensors, runs)."""
    if task.access == "single":
        return np.where(wanted.any(0), 1 + wanted.argmax(0), 0)
    if task.action == "discrete":
        return (wanted * 2 ** np.arange(task.sensors)[:, None]).sum(0)
    return wanted.T.astype(np.int64)
