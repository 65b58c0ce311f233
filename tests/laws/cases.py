"""The cases of the laws: every registered environment, and the options that change its parts."""

import functools
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from own_system import OWN_IDS

import fusion_gym
from fusion_gym.core.access import AccessOptions
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import ENVIRONMENTS

Array = NDArray[Any]
Options = dict[str, Any]
IDS = [name for name in ENVIRONMENTS if name not in OWN_IDS] + [*OWN_IDS]

SCARCE: Options = {
    "tokens": "limited", "token_rate": 0.5, "token_capacity": 30.0, "initial_tokens": 9.0,
    "token_cost": 3.0,
}  # fmt: skip
FREE: Options = {"tokens": "unlimited", "access": "any"}
DRAWN: Options = {"cost_weight": "random", "price_range": (0.001, 1.0), "clock": True}
LOSSY: Options = {"sensors": 3, "channel": "gilbert_elliott", "coefficient": (0.9, 1.0, 1.02)}
UNCENSORED: Options = {"filter": "kalman", "censoring_threshold": -np.inf, "random_start": True}
NOISY: Options = {
    "true_process_noise": (0.5, 2.0),
    "true_transition": (0.9, 1.1),
    "true_measurement_noise": 2.0,
    "memory": True,
}
VARYING: Options = {
    "transition": [[[1.0, 0.1], [0.0, 1.0]], [[0.9, 0.2], [-0.1, 0.8]], [[1.0, 0.0], [0.1, 0.9]]],
    "process_covariance": [[[0.1, 0.0], [0.0, 0.2]], [[0.0, 0.0], [0.0, 0.4]], [[0.2, 0.2]] * 2],
    "measurement_matrices": [[[1, 0], [1, 1], [0, 2]], [[0, 1], [0, 1], [1, 0]]],
    "measurement_covariances": [[0.2, 0.3, 0.4], [0.5, 0.1, 0.3]],
}
PAIRS: Options = {"access": "assignment", "channels": 2}
QUALITY = ((0.1, 0.8), (0.7, 0.2), (0.4, 0.5))
# Options that every environment has.
COMMON: list[Options] = [
    {},
    {"information": "centre", "access": "any", "clock": True},
    {"memory": True} | SCARCE | DRAWN,
    {"memory": True, "broadcast": "packets", "action": "discrete", "access": "any"},
    {"access": "single", "error": "trace"},
    {"memory": True, "access": "any", "tokens": "limited", "sharing": "turns"} | SCARCE,
    {"access": "round_robin", "broadcast": "estimate", "belief_features": "value"},
    {"access": "random", "error": "maximum", "error_weight": 2.0, "action": "multidiscrete"},
]
# Options of one environment.
VARIANTS: dict[str, list[Options]] = {
    "TobitOscillator": [
        {"filter": "tobit"},
        {"filter": "adf", "sharing": "fixed"} | SCARCE,
        {"filter": "stochastic", "stochastic_weight": 1.0, "fusion": "sici"},
        {"filter": "tobit", "fusion": "ci", "order": None},
        {"filter": "tobit", "fusion": "sci", "measurement_matrices": (((1.0, 0.0),),)},
        {"silent": "predict", "event_error": False, "process_noise": "full"},
        UNCENSORED | {"token_cost": (1.0, 2.0, 4.0), "sharing": "equal"},
        UNCENSORED | {"memory": True, "packet": "estimate"} | SCARCE,
        {"filter": "tobit", "true_threshold_shift": (-1.0, 1.0)} | NOISY,
    ],
    "CorrelatedTracking": [
        {"fusion": "sci", "order": (2, 0, 1)},
        {"fusion": "ci", "track_actual": True},
        {
            "fusion": "ici",
            "measurement_matrices": (((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),),
            "measurement_variance": ((0.6, 0.4),),
            "noise_coupling": 0.2,
        },
        {"noise_scale": "random"} | NOISY,
    ],
    "MarkovJumpTracking": [
        {"fusion": "ci"},
        {"fusion": "sici"},
        {"filter": "imm", "information": "centre"},
        {"filter": "imm"} | NOISY,
        {"filter": "centralised", "memory_filter": "imm", "memory": True},
    ],
    "UnknownInput": [
        {"filter": "predict", "fusion": "exact_ci"},
        {"filter": "paper", "input_signal": "steps"},
        {"hold_variance": 0.1, "input_signal": "random_walk", "fusion": "sici"},
        {"example": "paper", "input_phase": "random", "filter": "random_walk", "fusion": "ici"},
        {"filter": "paper"} | NOISY,
    ],
    "BiasedOscillator": [
        {"filter": "adf", "access": "any"},
        {"filter": "kalman", "random_start": True},
        {"bias_aware": False, "access": "round_robin"} | SCARCE,
        {"memory": True, "packet": "estimate", "memory_filter": "kalman"},
    ],
    "BiasedTracking": [
        {"filter": "stochastic", "stochastic_weight": 1.0, "access": "any", "fusion": "ici"}
    ],
    "RecordedFusion": [
        {"filter": "hold"},
        {"filter": "joint", "source": "normal"},
        {"fit_share": 0.7, "memory": True},
    ],
    "LinearFusion": [
        {"fusion": rule, "measurement_matrices": [[1, 0], [[0, 1], [1, 1]], [1, -1]]}
        for rule in ("ci", "sci")
    ]
    + [
        {"censoring_threshold": (-2.0, -2.0), "access": "round_robin"},
        {"filter": "adf", "packet": "estimate"} | NOISY,
        {"filter": "hold", "memory": True, "access": "any"} | SCARCE,
        {"filter": "truncated", "trigger": "report_on_change", "trigger_threshold": 0.8},
        {
            "measurement_matrices": [[1, 0], [[0, 1], [1, 1]]],
            "joint_measurement_covariance": [[0.3, 0.2, 0.1], [0.2, 0.3, 0.1], [0.1, 0.1, 0.2]],
        },
    ],
    "RemoteEstimation": [
        LOSSY | {"access": "single", "initial_deviation": 1.0},
        {"sensors": 2, "channel": "independent"},
        LOSSY | {"filter": "truncated", "trigger": "send_on_delta", "trigger_threshold": 1.5},
        LOSSY | {"information": "centre"} | SCARCE,
        LOSSY | {"memory": True, "true_transition": (0.8, 0.95)},
    ],
}
# Options of the network, beside those with recorded figures.
CHAINS: Options = {  # other losses of each sensor
    "channel": "gilbert_elliott", "drop_probability": ((0.9, 0.1), (0.5, 0.0), (0.3, 0.2)),
    "channel_transition": (((0.5, 0.5), (0.1, 0.9)), ((0.7, 0.3), (0.3, 0.7)), np.eye(2)),
    "initial_channel": "good",
}  # fmt: skip
NETWORKS: dict[str, list[Options]] = {
    "CorrelatedTracking": [
        {"channel": "gilbert_elliott", "acknowledgements": "none", "memory": True},
        {"access": "try_once_discard", "discrepancy": "held"} | SCARCE,
        {"delay": 2},
        CHAINS | {"delay": ((0, 0), (2, 2), (0, 1)), "memory": True},
        {"budget": "sensor", "harvest": "bernoulli", "memory": True} | SCARCE,
        PAIRS | {"channel": "independent", "drop_probability": QUALITY, "memory": True},
        {"schedule": {"process_variance": (0.1, 0.3, 0.2), "end": "hold"}, "memory": True},
        {"fusion": "ci", "memory": True},
    ],
    "LinearFusion": [
        {"access": "collision", "channel": "independent", "memory": True},
        {"delay": (0, 2), "memory": True, "channel": "independent"},
        {"budget": "sensor", "access": "single"} | SCARCE | {"token_rate": (0.2, 0.9)},
        PAIRS | {"channel": "gilbert_elliott", "delay": (0, 1)} | SCARCE,
        {"schedule": VARYING, "memory": True, "access": "any"} | SCARCE,
        {"schedule": VARYING | {"end": "hold"}, "delay": (0, 2), "fusion": "sci"} | NOISY,
        {"filter": "local", "channel": "independent", "acknowledgements": "none"},
        {"filter": "local", "memory": True, "budget": "sensor", "delay": 1} | SCARCE,
    ],
    "RecordedFusion": [{"filter": "local", "memory": True, "budget": "sensor"} | SCARCE],
    "Dropouts": [{"delay": (0, 2), "channel": "independent"}],
    "TobitOscillator": [
        {"access": "slots", "slots": 2, "channel": "gilbert_elliott"} | SCARCE,
        {"channel": "independent", "true_drop_probability": (0.2, 0.6), "memory": True}
        | SCARCE
        | {"token_rate": (0.2, 3.0)},
    ],
    "MarkovJumpTracking": [{"channel": "independent", "acknowledgements": 0.4}],
    "UnknownInput": [
        {"channel": "independent", "acknowledgements": "none"} | SCARCE,
        {"intersample_error": True, "delay": 1, "budget": "sensor"} | SCARCE,
    ],
    "RemoteEstimation": [
        {"sensors": 2, "channel": "independent", "acknowledgements": 0.5, "memory": True},
        {"sensors": 3, "access": "collision", "channels": 2},
        {"sensors": 3, "access": "try_once_discard", "slots": 2},
        LOSSY | {"delay": (1, 3), "information": "centre"},
        {"sources": (3, 1), "memory": True, "access": "any"} | SCARCE,
        {"sources": (2, 4), "channel": "independent", "acknowledgements": "none"},
        LOSSY
        | {"filter": "truncated", "trigger": "send_on_delta", "trigger_threshold": 1.5}
        | {"budget": "sensor"}
        | SCARCE,
    ],
}


@dataclass(frozen=True, eq=False)
class Case:
    """An environment with options."""

    env_id: str
    options: Options

    @functools.cache  # noqa: B019  cases live as long as the tests
    def task(self, **more: Any) -> Task:
        """The task, with further options; those of the network are exchanged, which is quick."""
        if self.options.get("budget") == "sensor":  # nothing to share
            more.pop("sharing", None)
        elif np.ndim(self.options.get("token_rate", 0.0)) and more.get("tokens") == "unlimited":
            more = {"token_rate": 0.5} | more  # nothing to draw
        if more and more.keys() <= SCARCE.keys() | FREE.keys():
            task = self.task()
            if task.network.rule.by_channel:  # its links are those of the access
                more.pop("access", None)
            elif "access" in more:
                kind = type(task.options)
                more = {f.name: getattr(kind, f.name) for f in fields(AccessOptions)} | more
            return task.with_options(**more)
        return fusion_gym.make_task(self.env_id, **self.options | more)

    def batch(
        self, runs: int = 3, seed: int = 0, owner: Owner | None = None, **more: Any
    ) -> EpisodeBatch:
        """Runs with the seeds ``seed``, ``seed + 1``, …, each at the start of an episode."""
        return EpisodeBatch.seeded(self.task(**more), runs, seed, owner)

    @property
    def local(self) -> bool:
        """Whether sensors can decide by themselves."""
        central = {("information", "centre"), ("packet", "estimate")}
        return not any(
            (name, self.options.get(name)) in central for name in ("information", "packet")
        )

    @property
    def local_memory(self) -> bool:
        """Whether sensors may have beliefs of their own."""
        return self.local and "delay" not in self.options

    @property
    def aspects(self) -> dict[str, bool]:
        """What it is a case of, and whether each law is tested with one."""
        options = {k: v for k, v in self.options.items() if k != "objective"}
        common = {str(options): True} if options in COMMON else {}
        named = {str(self): False} if self in CASES + NETWORK_CASES else {}
        return {self.env_id: True} | common | named

    def __str__(self) -> str:
        words = [f"{k}={v}" if isinstance(v, str) else k for k, v in self.options.items()]
        return "-".join([short(self.env_id), *words])


def skip_closed_loop(task: Task) -> None:
    """Skip a law of a plant that moves alike whatever is sent."""
    if task.controller is not None:
        pytest.skip("the controller acts on what was sent")


def short(env_id: str) -> str:
    """The name of an environment without namespace and version."""
    return env_id.partition("/")[2].partition("-")[0]


def adapted(env_id: str, options: Options) -> Options:
    """Options whose error is the estimate's, also where a controller has a cost."""
    closed = "error" in options and "GymnasiumEnvironment" in env_id
    return options | {"objective": "estimation"} if closed else options


CASES = [
    Case(env_id, adapted(env_id, options))
    for env_id in IDS
    for options in COMMON + VARIANTS.get(short(env_id), [])
]
NETWORK_CASES = [Case(i, options) for i in IDS for options in NETWORKS.get(short(i), [])]
each_case = pytest.mark.parametrize("case", CASES + NETWORK_CASES, ids=str)
each_id = pytest.mark.parametrize("env_id", IDS, ids=short)


def requests(task: Task, runs: int, steps: int, rate: float = 0.4) -> NDArray[np.bool_]:
    """Random requests (steps, sensors, runs), always the same; one per step with single access."""
    request = np.random.default_rng(7).random((steps, task.sensors, runs)) < rate
    return request & (request.cumsum(1) == 1) if task.options.access == "single" else request


def actions(task: Task, request: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Actions (runs, …) of a scheduler for the requests (sensors, runs)."""
    if task.options.access == "single":
        return np.where(request.any(0), 1 + request.argmax(0), 0)
    if task.options.action == "discrete":
        return (request * 2 ** np.arange(task.sensors)[:, None]).sum(0)
    return request.T.astype(np.int64)


def read(batch: EpisodeBatch) -> Signals:
    """All signals of an estimator, withheld ones too."""
    return Signals(batch.read())
