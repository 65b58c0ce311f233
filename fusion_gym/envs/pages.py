"""An environment's page and its tables, from the declarations of options, blocks and spaces."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from fusion_gym.core.action import space_text
from fusion_gym.core.knowledge import FEATURES, Block, covers, numbered
from fusion_gym.core.memory import Owner
from fusion_gym.core.observation import belief_blocks, block_entries, network_blocks
from fusion_gym.core.task import CommonOptions, Task
from fusion_gym.docstrings import plain_marks, read, table
from fusion_gym.envs.option_text import list_options, options_in, short
from fusion_gym.envs.registration import make_task, options_of
from fusion_gym.envs.views import is_received, make_view

LEGEND = """\
A star marks entries that only the sensors know; `information="centre"` omits them. The third column
gives the entries that a local sensor observes. With `broadcast="estimate"` it also observes entries
without a star that belong to no sensor, with `broadcast="packets"` all entries without a star."""

_PAGE = Path(__file__).with_name("page.md")  # a template for page()
# Network blocks of some tasks, and their conditions.
_NETWORK = {
    "energy": 'in place of `tokens` with `budget="sensor"`',
    "admitted": 'only with `access="round_robin"` or `"random"`',
    "queue": 'only with `sharing="turns"` and limited tokens',
    "time_left": "only with `clock=True`",
    "token_rate": "only with a range as `token_rate`",
    "price": "only with a `price_range`",
}
# Conditions of the belief blocks of the scheduler and of a local sensor.
_BELIEFS: dict[Owner, str] = {
    "scheduler": "only with `memory=True` or `belief_features`",
    "own": "only with `memory=True` or `belief_features`, for local sensors",
}
_SEES = {"own": "its own", "broadcast": "all", "hidden": "none"}
_QUEUE = ", sensors share limited tokens in turns"
_SECOND = f"v1: covariances may be singular{_QUEUE}; counters generate the noise."


def page(env_id: str, task: Task | None = None) -> str:
    """Return the page of a registered environment.

    The docstring of its options' dataclass gives title and description; paragraphs that begin with
    ``v1:``, ``v2:``, … are the version history.

    Args:
        env_id: Id of the environment.
        task: A task of the environment; ``None`` takes the default options.
    """
    kind = options_of(env_id)
    task = make_task(env_id) if task is None else task
    plant, view = task.plant, make_view(task)
    description = _paragraphs(kind) or [env_id]
    versions = [text for text in description if re.match(r"v\d+: ", text)]
    if kind.__module__.startswith("fusion_gym."):
        versions.insert(0, _SECOND if kind().sharing == "turns" else _SECOND.replace(_QUEUE, ""))
    weights = task.reward.state_weights[..., 0]
    return _PAGE.read_text(encoding="utf-8").format(
        description="\n\n".join(text for text in description if not re.match(r"v\d+: ", text)),
        actions=space_text(view.action.space),
        action=view.action.meaning,
        entries=len(view.names),
        sensors=task.sensors,
        states=", ".join(plant.state_names),
        legend=LEGEND,
        table=observation_table(task),
        weights=short(weights),
        open_loop=f"{float(task.reward.diagonal[:, 0] @ plant.open_loop(task.horizon)):.3g}",
        horizon=task.horizon,
        options=kind.__name__,
        arguments="\n".join(f"    {plain_marks(line)}" for line in list_options(options_in(kind))),
        history="\n".join(f"- {text}" for text in ["v0: first version.", *versions]),
    )


def observation_table(task: Task, *others: tuple[str, Task]) -> str:
    """Return the observation blocks of all information modes as a Markdown table.

    Args:
        task: The task.
        *others: Names and tasks of the same environment; their additional blocks carry the name.
    """
    rows = {block.name: _row(task, block) for block in task.estimator.observation}
    for name, other in others:
        for block in other.estimator.observation:
            rows.setdefault(block.name, _row(other, block, f"only with {name}"))
    features = task.belief_features or FEATURES
    with_memory = task.with_options(
        memory=True, belief_features=features, information="sensors", delay=0
    )
    for owner, condition in _BELIEFS.items():
        for block in belief_blocks(with_memory, owner):
            visible = bool(task.belief_features) and owner == "scheduler"
            rows[block.name] = _row(task, block, "" if visible else condition)
    always = [block.name for block in network_blocks(task)]
    usual = type(task.options)
    unused = ("slots", "channels", "discrepancy", "discrepancy_weights")
    access = {name: getattr(usual, name) for name in unused} | {"access": "round_robin"}
    if task.network.rule.by_channel:
        access = {}
    bucket = task.network.bucket
    rates: Any = {} if bucket.per_sensor else {"token_rate": (0.0, 1.0)}
    own = {"budget": "sensor", "sharing": usual.sharing, "token_rate": np.ravel(bucket.rate)}
    for options in ({"sharing": "turns"} | rates, own):
        every = task.with_options(
            **access,
            **options,
            tokens="limited",
            token_capacity=1e6,
            clock=True,
            cost_weight="random",
            price_range=(0.01, 1.0),
        )
        for block in network_blocks(every):
            condition = "" if block.name in always else _NETWORK[block.name]
            rows[block.name] = _row(task, block, condition)
    return table(("entries", "range", "a sensor observes", "meaning"), rows.values())


def _paragraphs(kind: type[CommonOptions]) -> list[str]:
    text = read(kind).text
    # The default docstring of a dataclass is its signature.
    return [] if text.startswith(f"{kind.__name__}(") else plain_marks(text).split("\n\n")


def _row(task: Task, block: Block, condition: str = "") -> tuple[str, ...]:
    axes = ",".join(_axis(task, block, place) for place in range(len(block.labels)))
    name = f"`{block.name}[{axes}]`" if axes else f"`{block.name}`"
    star = "" if covers("centre", block.knowledge) else " *"
    low, high = block.bounds
    meaning = plain_marks(block.meaning) + (f"; {condition}" if condition else "")
    received = all(is_received(entry, task.broadcast) for entry in block_entries(block))
    seen = "all" if received else _SEES[block.node]  # by a local sensor
    return name + star, f"{low:g}..{high:g}", seen, meaning


def _axis(task: Task, block: Block, place: int) -> str:
    """Return the name of an axis: sensor, state, component, or its own labels."""
    labels = block.labels[place]
    if place == 0 and (block.node == "own" or labels == numbered(task.sensors)):
        return "sensor"
    if labels == task.plant.state_names:
        return "state"
    return "component" if place and labels == numbered(len(labels)) else "/".join(labels)
