"""One episode of every rule: the error, and who transmitted when."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

import fusion_gym
from fusion_gym.agents.output import palette
from fusion_gym.agents.output.palette import plt
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.policies.base import owner_of
from fusion_gym.policies.registry import make_policy

STEPS = 80
_TOBIT = (
    "fusion_gym/TobitOscillator-v0",
    {"filter": "tobit", "random_start": True, "token_rate": 2.0},
)
_MEMORY = (_TOBIT[0], {**_TOBIT[1], "memory": True})
_MARKOV: tuple[str, dict[str, Any]] = ("fusion_gym/MarkovJumpTracking-v0", {})
_REMOTE: tuple[str, dict[str, Any]] = ("fusion_gym/RemoteEstimation-v0", {})
_TWO = (_REMOTE[0], {"sensors": 2, "cost_weight": 5.0})
# What is asked of which environment; elsewhere the name alone, of the Tobit oscillator.
SETTINGS: dict[str, tuple[str, tuple[str, dict[str, Any]]]] = {
    "adaptive_innovation": ("adaptive_innovation", ("fusion_gym/CorrelatedTracking-v0", {})),
    "always": ("always", (_TOBIT[0], {**_TOBIT[1], "tokens": "unlimited"})),
    "adaptive_threshold": ("adaptive_threshold", ("fusion_gym/UnknownInput-v0", {})),
    "centre_variance": ("centre_variance:threshold=2.5", _MARKOV),
    "dynamic_event": ("dynamic_event:scale=3", _TOBIT),
    "estimate_difference": ("estimate_difference:threshold=0.25", _MEMORY),
    "information_gain": ("information_gain:threshold=0.2", _TOBIT),
    "innovation_threshold": ("innovation_threshold:threshold=1.2", _TOBIT),
    "kullback_leibler": ("kullback_leibler:threshold=0.8,at_most=1", _MEMORY),
    "local_variance": ("local_variance:m=0.9", _MARKOV),
    "lookahead": ("lookahead:price=0.03", _MEMORY),
    "optimal": ("optimal", _REMOTE),
    "paced": ("paced:rate=0.07", _TOBIT),
    "periodic": ("periodic:period=15", _TOBIT),
    "periodic_optimum": ("periodic_optimum:packets=2,period=6", _MARKOV),
    "random": ("random:rate=0.07", _TOBIT),
    "rollout": (
        "rollout:samples=8,price=0.03,base=value_of_information:price=0.006,at_most=1",
        _MEMORY,
    ),
    "round_robin": ("round_robin:period=5", _TOBIT),
    "send_on_delta": ("send_on_delta:threshold=3", _TOBIT),
    "stochastic_event": ("stochastic_event:weight=0.3", _TOBIT),
    "value_of_information": ("value_of_information:threshold=0.03,at_most=1", _MEMORY),
    "variance_threshold": ("variance_threshold:threshold=0.25", _TOBIT),
    "whittle": ("whittle:price=5", _TWO),
}
_KNOWING = {
    "own_memory": palette.RULES_MEMORY,
    "coordinator_memory": palette.RULES_MEMORY,
}


def drawn(name: str, reference: bool) -> tuple[bytes, str]:
    """The figure of a policy as SVG, and its caption."""
    spec, (env_id, options) = SETTINGS.get(name, (name, _TOBIT))
    task = fusion_gym.make_task(env_id, **options)
    errors, granted, denied, known = _episode(task, spec)
    style = palette.REFERENCE if reference else _KNOWING.get(known, palette.RULES)
    with plt.rc_context({**palette.LARGE, "svg.fonttype": "path"}):
        figure, (above, below) = plt.subplots(
            2, sharex=True, figsize=(9, 4.6), height_ratios=(2, 1), layout="constrained"
        )
        steps = np.arange(1, len(errors) + 1)
        above.plot(steps, errors, color=palette.INK, lw=1.4)
        above.set_ylabel("squared error,\nweighted (–)")
        above.set_ylim(bottom=0.0)
        for sensor, (sent, refused) in enumerate(zip(granted.T, denied.T, strict=True)):
            below.plot(steps[refused], np.full(refused.sum(), sensor), "x", color="0.55", ms=6)
            below.plot(
                steps[sent], np.full(sent.sum(), sensor), "|", color=style.colour, ms=15, mew=3
            )
        below.set_yticks(range(granted.shape[1]), [f"sensor {i}" for i in range(granted.shape[1])])
        below.set_ylim(-0.6, granted.shape[1] - 0.4)
        below.set_xlabel("step")
        below.grid(axis="y", visible=False)
        image = io.BytesIO()
        figure.savefig(image, format="svg", metadata={"Date": None})
        plt.close(figure)
    return image.getvalue(), _caption(spec, env_id, errors, granted, denied)


def _caption(spec: str, env_id: str, errors: Any, granted: Any, denied: Any) -> str:
    refused = f"; {denied.sum()} more were denied (grey crosses)" if denied.any() else ""
    return (
        f"{spec} in {env_id.split('/')[1]}, the first {len(errors)} steps of the "
        f"episode of seed 0. Above: the fused estimate's error in the reward's weights, on average "
        f"{errors.mean():.2g}. Below: the {granted.sum()} transmissions, a row a sensor{refused}. "
        f"Look where the error grows, and whether a transmission takes it off."
    )


def _episode(task: Task, spec: str) -> tuple[Any, Any, Any, str]:
    """Weighted squared errors (T,), and requests that were granted and denied (T, sensors)."""
    policy = make_policy(spec, task)
    batch = EpisodeBatch.seeded(task, 1, 0, owner_of(policy))
    policy.reset(1, 0)
    errors, granted, denied = [], [], []
    for _ in range(min(STEPS, task.horizon)):
        outcome = batch.step(policy(batch.signals()))
        weights = task.reward.state_weights
        errors.append(float((weights * outcome.squared_error).sum()))
        granted.append(outcome.granted[:, 0])
        denied.append((outcome.requested & ~outcome.granted)[:, 0])
    return np.array(errors), np.array(granted), np.array(denied), policy.knowledge
