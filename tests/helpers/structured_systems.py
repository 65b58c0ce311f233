"""Random systems of every family with the structure that breaks estimators, and what a run keeps.

Noise of rank 0 and 1, repeated poles and Jordan blocks, states that nobody sees, decaying, dead and
growing directions, states of very different scales, starts that are known, sensors of unequal size,
long silence.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym import ConfigurationError, make_task
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import present_id

Array = NDArray[np.float64]
Options = dict[str, Any]
PATTERNS = ("never", "rarely", "always", "random", "bursts")
_DECAYS = (0.0, 0.05, 0.5, 0.9, 1.0)
_GROWTHS = (1.02, 1.05, 1.1, 1.3)
_HIDDEN = 40  # steps of most episodes of the exact filter of an unknown input
_LARGEST = 300.0  # by which most growing directions grow in an episode


@dataclass(frozen=True)
class Drawn:
    """Options of an environment and the states that are known exactly after the first step."""

    env_id: str
    options: Options
    known: tuple[int, ...] = ()


@dataclass
class Plant:
    """x' = A x + F w, w of unit variance, from x(0) ~ N(mean, start); states have their scales."""

    transition: Array
    factor: Array
    mean: Array
    start: Array
    scale: Array
    horizon: int
    known: tuple[int, ...]

    @property
    def covariance(self) -> Array:
        """Of the process noise, (n, n)."""
        return self.factor @ self.factor.T

    def rows(self, random: np.random.Generator, count: int) -> Array:
        """Rows of a measurement matrix (count, n): some zero, some of one state only."""
        size = len(self.scale)
        rows = random.normal(size=(count, size))
        rows *= random.random((count, size)) < random.choice((0.4, 1.0))
        rows[random.random(count) < 0.15] = 0.0
        return rows / self.scale


def draw_plant(
    random: np.random.Generator, horizon: int, *, stable: bool = False, dead: bool = True
) -> Plant:
    """A plant of one to four states; ``dead`` ones may be zero from the first step on."""
    blocks, growth = [], 1.0
    while sum(map(len, blocks)) < random.integers(1, 5):
        kind = random.choice(("single", "single", "jordan", "rotation", "growing"))
        pole = float(random.choice(_DECAYS[not dead :])) * float(random.choice((1.0, 1.0, -1.0)))
        if kind == "growing" and not stable:
            growth = max(growth, pole := float(random.choice(_GROWTHS)))
        pole = 0.9 * pole if stable else pole
        block = np.array([[pole]])
        if kind == "jordan":
            block = np.array([[pole, random.choice((0.1, 1.0))], [0.0, pole]])
        elif kind == "rotation":
            turn = random.uniform(0.0, np.pi)
            block = abs(pole) * np.array(
                [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
            )
        blocks.append(block)
    size = sum(map(len, blocks))
    transition, place = np.zeros((size, size)), 0
    for block in blocks:
        transition[place : place + len(block), place : place + len(block)] = block
        place += len(block)
    rank = int(random.choice((0, 1, 1, size)))
    factor = random.normal(size=(size, max(rank, 1))) * 10.0 ** random.uniform(-2.0, 0.0)
    factor *= random.random((size, 1)) < 0.8
    factor *= float(rank > 0)
    if random.random() < 0.4:
        turned = np.linalg.qr(random.normal(size=(size, size)))[0]
        transition, factor = turned @ transition @ turned.T, turned @ factor
    still = ~transition.any(1) & ~factor.any(1)
    scale = 10.0 ** random.uniform(-3.0, 3.0, size) if random.random() < 0.3 else np.ones(size)
    if growth > 1.0 and random.random() < 0.9:
        horizon = min(horizon, int(np.log(_LARGEST) / np.log(growth)))
    root = random.normal(size=(size, size)) * 0.1
    own = random.spawn(1)[0]  # the other draws stay as they are
    unknown = np.ones(size) if own.random() < 0.6 else own.random(size) < own.choice((0.0, 0.5))
    reached = factor.any(1)
    for _ in range(size):
        reached |= (transition != 0.0) @ reached
    if not (dead and (unknown.any() or reached.any())):  # somebody must be uncertain some time
        unknown = np.maximum(unknown, ~reached)
    alone = np.count_nonzero(transition, axis=1) == (np.diagonal(transition) != 0.0)
    still |= alone & (unknown == 0.0) & ~factor.any(1)
    return Plant(
        transition=transition * scale[:, None] / scale,
        factor=factor * scale[:, None],
        mean=random.choice((0.0, 5.0)) * random.normal(size=size) * scale,
        start=(root @ root.T + 0.1 * np.eye(size)) * np.outer(unknown * scale, unknown * scale),
        scale=scale,
        horizon=horizon,
        known=tuple(np.flatnonzero(still).tolist()),
    )


def _variances(random: np.random.Generator, *shape: int) -> Array:
    return np.asarray(10.0 ** random.uniform(-2.0, 0.5, shape))


def _pick(random: np.random.Generator, *choices: Any) -> Any:
    return choices[int(random.integers(len(choices)))]


def _fusion(random: np.random.Generator, options: Options, usual: Any, sensors: int) -> Options:
    """The options with a rule that joins the nodes' estimates, where there are nodes."""
    if options["filter"] in ("adf", "joint"):
        return options
    rules = [usual, usual, "ci", "sci", "sici", *(["ici"] if sensors == 2 else [])]
    weight = {"stochastic_weight": 1.0} if options["filter"] == "stochastic" else {}
    return options | weight | {"fusion": _pick(random, *rules)}


def _tobit(random: np.random.Generator, horizon: int) -> Drawn:
    plant = draw_plant(random, horizon)
    size, sensors, channels = len(plant.scale), int(random.integers(1, 4)), _pick(random, 1, 2)
    options = {
        "transition": plant.transition,
        "process_gain": plant.factor[:, 0],
        "process_variance": 1.0,
        "initial_mean": plant.mean,
        "initial_covariance": plant.start,
        "measurement_matrices": plant.rows(random, sensors * channels).reshape(sensors, -1, size),
        "measurement_variance": _variances(random, sensors, channels),
        "censoring_threshold": float(_pick(random, 0.0, -1.0, -np.inf)),
        "filter": _pick(random, "paper", "paper", "tobit", "tobit", "kalman", "adf", "stochastic"),
        "horizon": plant.horizon,
    }
    ranks = np.linalg.matrix_rank(options["measurement_matrices"])
    if (ranks < channels).any():  # a held measurement must have independent rows
        options["silent"] = "predict"
    return Drawn("TobitOscillator", _fusion(random, options, None, sensors), plant.known)


def _biased(env_id: str) -> Callable[[np.random.Generator, int], Drawn]:
    def draw(random: np.random.Generator, horizon: int) -> Drawn:
        plant = draw_plant(random, horizon, dead=False)
        size, sensors, biases = len(plant.scale), int(random.integers(1, 4)), _pick(random, 1, 2)
        noise = random.normal(size=(biases, 1)) * _pick(random, 0.0, 0.0, 0.1)
        threshold = _pick(random, 5.0, np.inf)
        pole = float(random.choice(_DECAYS[1:]))
        inner = pole * np.eye(biases) + np.eye(biases, k=1) * _pick(random, 0.0, 1.0)
        options = {
            "transition": plant.transition,
            "process_covariance": plant.covariance,
            "initial_mean": plant.mean,
            "initial_covariance": plant.start,
            "bias_gain": plant.scale[:, None] * random.normal(size=(size, biases)) * 0.1,
            "bias_transition": inner,
            "bias_noise_covariance": noise @ noise.T,
            "bias_initial_mean": np.zeros(biases),
            "bias_initial_covariance": 0.1 * np.eye(biases),
            "measurement_matrices": plant.rows(random, sensors)[:, None],
            "measurement_variance": _variances(random, sensors, 1),
            "censoring_threshold": -threshold,
            "censoring_upper": threshold,
            "access": "any",
            "filter": _pick(random, "paper", "paper", "kalman", "adf", "stochastic"),
            "bias_aware": bool(random.random() < 0.8),
            "horizon": plant.horizon,
        }
        return Drawn(env_id, _fusion(random, options, None, sensors))

    return draw


def _correlated(random: np.random.Generator, horizon: int) -> Drawn:
    plant = draw_plant(random, horizon, dead=False)
    size, sensors, channels = len(plant.scale), int(random.integers(1, 4)), _pick(random, 1, 2)
    rule = _pick(random, "sici", "sici", "sci", "ci", *(["ici"] if sensors == 1 else []))
    options = {
        "transition": plant.transition,
        "process_gain": plant.factor,
        "process_variance": 1.0,
        "initial_mean": plant.mean,
        "initial_covariance": plant.start,
        "measurement_matrices": plant.rows(random, sensors * channels).reshape(sensors, -1, size),
        "measurement_variance": _variances(random, sensors, channels),
        "noise_coupling": random.normal(size=sensors) * _pick(random, 0.0, 0.3),
        "noise_scale": _pick(random, 1.0, 0.5, "random"),
        "trigger_threshold": 0.6,
        "trigger_offset": 0.2,
        "trigger_sensitivity": 0.9,
        "fusion": rule,
        "horizon": plant.horizon,
    }
    return Drawn("CorrelatedTracking", options, plant.known)


def _markov_jump(random: np.random.Generator, horizon: int) -> Drawn:
    plant = draw_plant(random, horizon, stable=True, dead=False)
    size, sensors = len(plant.scale), int(random.integers(1, 4))
    other = plant.transition * _pick(random, 1.0, 0.5, 0.0)
    kind = _pick(random, "local", "local", "centralised", "imm")
    rules = [None, None, "ci", "sci", "sici", *(["ici"] if sensors == 2 else [])]
    rank = plant.factor.shape[1]
    options = {
        "transitions": [plant.transition, other],
        "process_gains": [plant.factor, plant.factor * _pick(random, 0.0, 1.0)],
        "process_covariance": np.eye(rank),
        "mode_transition": _pick(random, [[0.7, 0.3], [0.3, 0.7]], [[1.0, 0.0], [0.1, 0.9]]),
        "initial_mean": plant.mean,
        "initial_covariance": plant.start,
        "measurement_matrices": plant.rows(random, sensors * 2).reshape(sensors, 2, size),
        "sampling_periods": random.integers(1, 4, sensors),
        "fading_values": [[0.0, 0.5, 1.0]] * sensors,
        "fading_probabilities": [_pick(random, [0.2, 0.4, 0.4], [0.0, 0.0, 1.0])] * sensors,
        "noise_coupling": random.normal(size=(sensors, rank)) * _pick(random, 0.0, 0.3),
        "measurement_variance": _variances(random, sensors),
        "filter": kind,
        "fusion": _pick(random, *rules) if kind == "local" else None,
        "horizon": plant.horizon,
    }
    return Drawn("MarkovJumpTracking", options)


def _unknown_input(random: np.random.Generator, horizon: int) -> Drawn:
    plant = draw_plant(random, horizon)
    size, sensors = len(plant.scale), int(random.integers(1, 4))
    channels = _pick(random, 1, 2)
    reach = plant.scale[:, None] * random.normal(size=(size, 1))
    matrices = plant.rows(random, sensors * channels).reshape(sensors, channels, size)
    matrices[:, 0] = random.normal(size=(sensors, size)) / plant.scale  # sees the input
    kind = _pick(random, "random_walk", "random_walk", "predict")
    options = {
        "transition": plant.transition,
        "input_matrix": reach,
        "process_covariance": plant.covariance,
        "sampling_period": 1,
        "initial_mean": plant.mean,
        "initial_covariance": plant.start,
        "input_signal": _pick(random, "sinusoids", "steps", "random_walk"),
        "measurement_matrices": matrices,
        "measurement_covariance": _variances(random, sensors, channels),
        "filter": kind,
        "input_memory": _pick(random, 0.9, 1.0, 0.0),
        "hold_variance": _pick(random, None, 0.1) if kind == "random_walk" else None,
        "fusion": _pick(random, "ci", "sci", "sici", *(["ici"] if sensors == 2 else [])),
        "horizon": plant.horizon,
    }
    if kind == "predict" and random.random() < 0.9:  # inputs often hide what grows
        options["horizon"] = min(plant.horizon, _HIDDEN)
    return Drawn("UnknownInput", options)


def _remote(random: np.random.Generator, horizon: int) -> Drawn:
    sensors = int(random.integers(1, 5))
    coefficient = random.choice((*_DECAYS, 1.02, 1.05), sensors)
    growth = float(np.abs(coefficient).max())
    if growth > 1.0 and random.random() < 0.9:
        horizon = min(horizon, int(np.log(_LARGEST) / np.log(growth)))
    options = {
        "sensors": sensors,
        "coefficient": coefficient,
        "noise_deviation": 10.0 ** random.uniform(-3.0, 3.0, sensors),
        "initial_deviation": random.choice((0.0, 5.0)),
        "channel": _pick(random, "perfect", "independent", "gilbert_elliott"),
        "horizon": horizon,
    }
    return Drawn("RemoteEstimation", options)


def draw_linear(random: np.random.Generator, horizon: int, exact: bool = False) -> Drawn:
    """Of LinearFusion; ``exact`` draws uncensored sensors with the Kalman filter in its forms."""
    plant = draw_plant(random, horizon)
    sensors = int(random.integers(1, 4))
    sizes = random.integers(1, 4, sensors)
    whole = int(sizes.sum())
    limit = np.inf if exact or random.random() < 0.6 else 3.0
    kinds = ("kalman", "adf", "joint") if exact else ("kalman", "kalman", "tobit", "adf", "joint")
    options = {
        "transition": plant.transition,
        "process_covariance": plant.covariance,
        "initial_mean": plant.mean,
        "initial_covariance": plant.start,
        "measurement_matrices": [plant.rows(random, size) for size in sizes],
        "filter": _pick(random, *kinds, *([] if exact else ["stochastic"])),
        "horizon": plant.horizon,
    }
    if np.isinf(limit) and options["filter"] == "joint" and random.random() < 0.5:
        root = random.normal(size=(whole, whole)) * 0.3
        options["joint_measurement_covariance"] = root @ root.T + 0.1 * np.eye(whole)
    else:
        factors = [random.normal(size=(size, size)) * 0.3 for size in sizes]
        correlated = np.isinf(limit) and random.random() < 0.5
        options["measurement_covariances"] = [
            f @ f.T + 0.05 * np.eye(len(f)) if correlated else np.diag(_variances(random, len(f)))
            for f in factors
        ]
        options |= {"censoring_threshold": -limit, "censoring_upper": limit}
    drawn = options if exact else _fusion(random, options, None, sensors)
    return Drawn("LinearFusion", drawn, plant.known)


FAMILIES: dict[str, Callable[[np.random.Generator, int], Drawn]] = {
    "TobitOscillator": _tobit,
    "BiasedOscillator": _biased("BiasedOscillator"),
    "BiasedTracking": _biased("BiasedTracking"),
    "CorrelatedTracking": _correlated,
    "MarkovJumpTracking": _markov_jump,
    "UnknownInput": _unknown_input,
    "RemoteEstimation": _remote,
    "LinearFusion": draw_linear,
}


def draw(family: str, number: int, horizon: int) -> Drawn:
    """The system of this number, always the same."""
    random = np.random.default_rng([list(FAMILIES).index(family), number])
    drawn = FAMILIES[family](random, horizon)
    options = drawn.options | {"tokens": "unlimited"}
    return Drawn(present_id(drawn.env_id), options, drawn.known)


def request(random: np.random.Generator, step: int, sensors: int, runs: int) -> NDArray[np.bool_]:
    """Requests (sensors, N) of a step: run r follows the pattern r, in turn."""
    uniform = random.random((sensors, runs))
    quiet = step % 300 >= 100
    bound = {"never": 0.0, "rarely": 0.01, "always": 1.0, "random": 0.5, "bursts": 1.0 - quiet}
    return np.asarray(uniform < np.resize([bound[pattern] for pattern in PATTERNS], runs))


@dataclass
class Survey:
    """What became of the drawn systems: steps that were run, refusals by reason, and failures."""

    drawn: int = 0
    run_steps: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def add(self, drawn: Drawn, runs: int, name: str) -> None:
        """Run an episode of the system and note what it breaks."""
        self.drawn += 1
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".*rounding errors may reach")
                warnings.filterwarnings("ignore", message=".*no sensor measures it")
                task = make_task(drawn.env_id, **drawn.options)
        except ConfigurationError as error:
            self.refused[reason(str(error))] += 1
            return
        except Exception as error:
            self.failures.append(f"{name}: when made, {type(error).__name__}: {error}")
            return
        batch, random = EpisodeBatch.seeded(task, runs, seed=0), np.random.default_rng(0)
        for step in range(task.horizon):
            try:
                batch.observe()
                outcome = batch.step(request(random, step, task.sensors, runs))
                fault = flaw(batch, outcome.reward, drawn.known)
            except Exception as error:
                fault = f"{type(error).__name__}: {error}"
            if fault:
                kind = {key: drawn.options.get(key) for key in ("filter", "fusion")}
                self.failures.append(f"{name} {kind}: step {step}, {fault}")
                return
        self.run_steps += runs * task.horizon

    def __str__(self) -> str:
        lines = [f"{self.drawn} systems, {self.run_steps:,} run-steps"]
        lines += [f"refused {count}: {why}" for why, count in self.refused.most_common()]
        return "\n".join([*lines, *self.failures])


def reason(message: str) -> str:
    """The kind of a refusal: its message without numbers."""
    return "".join("#" if letter.isdigit() else letter for letter in message)[:160]


def flaw(batch: EpisodeBatch, reward: Array, known: tuple[int, ...]) -> str | None:
    """What is wrong after a step, of all runs."""
    estimator, estimate = batch.task.estimator, batch.delivered.estimate
    mean, covariance = estimator.mean(estimate), estimator.covariance(estimate)
    values = {"observation": batch.observe(), "reward": reward, "mean": mean, "cov": covariance}
    for name, value in values.items():
        if not np.isfinite(value).all():
            runs = value if name == "observation" else np.moveaxis(value, -1, 0)
            whole = np.isfinite(runs.reshape(len(runs), -1)).all(1)
            return f"{name} is not finite in the runs {np.flatnonzero(~whole).tolist()[:5]}"
    if not np.array_equal(covariance, covariance.swapaxes(0, 1)):
        return "the covariance is not symmetric"
    variance = np.einsum("iin->in", covariance)
    if (variance < 0.0).any():
        return f"a variance of {variance.min()}"
    if variance[list(known)].any():
        return f"a known state has a variance of {variance[list(known)].max()}"
    scale = np.where(variance > 1e-290, 1.0 / np.sqrt(np.maximum(variance, 1e-290)), 0.0)
    unit = np.moveaxis(covariance * scale[:, None] * scale, -1, 0)
    smallest = float(np.linalg.eigvalsh(unit)[:, 0].min())
    return f"an eigenvalue of the correlations is {smallest:.2g}" if smallest < -1e-12 else None
