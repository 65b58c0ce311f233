"""One episode of every rule: the error, and who transmitted when."""

import io
from typing import Any

import numpy as np

from fusion_gym.agents.output import palette
from fusion_gym.agents.output.palette import plt
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.pages import task_of
from fusion_gym.policies.base import owner_of
from fusion_gym.policies.registry import make_policy
from website.parts import Part, example_of

STEPS = 80
_KNOWING = {
    "own_memory": palette.RULES_MEMORY,
    "scheduler_memory": palette.RULES_MEMORY,
}


def drawn(part: Part) -> tuple[bytes, str]:
    """The figure of a policy's example as SVG, and its caption."""
    spec, env = example_of(part)
    task = task_of(env)
    errors, granted, denied, known = _episode(task, spec)
    reference = part.kind == "reference"
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
    return image.getvalue(), _caption(spec, env.split()[0], errors, granted, denied)


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
