"""Plants and sensors whose matrices vary with the step."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Self, cast

import numpy as np

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.task import CommonOptions
from fusion_gym.declaration import plain_options
from fusion_gym.errors import ConfigurationError, forbidden, refusal
from fusion_gym.namespace import namespace, take
from fusion_gym.option_file import load_yaml

_NAME, _END = "schedule", "end"
_ENDS = ("repeat", "hold")
_FACTOR = "process_factor"
_OF_SENSORS = ("measurement_", "noise_")  # options with an entry for each sensor


class MatrixSchedule(NamedTuple):
    """Arrays (…, T) of a part's fields over T steps.

    After the last step ``hold`` keeps its matrices; otherwise the schedule repeats.
    """

    stacks: Mapping[str, Array]
    steps: int
    hold: bool

    def at(self, step: Array) -> dict[str, Array]:
        """Return the fields (…, N) at steps (N,)."""
        last = self.steps - 1
        place = namespace(step).minimum(step, last) if self.hold else step % self.steps
        return {name: take(stack, place.astype(np.int64)) for name, stack in self.stacks.items()}


class Scheduled:
    """The common part of plants and sensors that a :class:`MatrixSchedule` may change."""

    schedule: MatrixSchedule | None = None

    def at(self, step: Array) -> Self:
        """Return the part with its matrices (…, N) at steps (N,)."""
        if self.schedule is None:
            return self
        own: Any = self
        return cast(Self, replace(own, schedule=None, **self.schedule.at(step)))

    @property
    def period(self) -> int:
        """Number of steps of the schedule, 1 without one."""
        return 1 if self.schedule is None else self.schedule.steps

    @property
    def each_step(self) -> Self:
        """The part with the matrices (…, T) of all steps of its schedule."""
        return self.at(np.arange(float(self.period)))

    def refuse_schedule(self, where: str) -> None:
        """Raise an error if the matrices vary with the step."""
        if self.schedule is not None:
            raise ConfigurationError(f"{_NAME} is not allowed {where}: it needs constant matrices")


def read_schedule(value: Any) -> dict[str, Any] | None:
    """Return the entries of an option ``schedule``, a mapping or the path of its file.

    Args:
        value: a mapping, the path of a YAML or .npz file, or None.

    Raises:
        ConfigurationError: another value, or a file that cannot be read.
    """
    path = Path(value if isinstance(value, str) else "")
    if path.suffix in (".yaml", ".yml"):
        value = load_yaml(_NAME, path)
    elif path.suffix == ".npz":
        try:
            with np.lib.npyio.NpzFile(path.open("rb"), own_fid=True) as arrays:
                value = {name: arrays[name].tolist() for name in arrays}
        except Exception as error:  # of a damaged file
            raise ConfigurationError(f"{_NAME} = {value!r} cannot be read: {error}") from None
    if value is not None and not isinstance(value, dict):
        allowed = "a dictionary of stacks, or the path of a YAML or .npz file with them"
        raise refusal(_NAME, value, allowed)
    return value


def scheduled_parts(
    options: CommonOptions, names: Collection[str], build: Callable[[Any, Any], Sequence[Any]]
) -> Sequence[Any]:
    """Return the parts that ``build`` makes of options, with the option ``schedule`` in them.

    Args:
        options: options of the environment.
        names: options that a schedule may contain.
        build: function of the options at a step and at the step before.

    Raises:
        ConfigurationError: a stack that is not allowed, or whose entry at a step is not.
    """
    schedule = cast(Any, options).schedule
    if schedule is None:
        return build(options, options)
    own = {str(name): value for name, value in schedule.items()}
    hold = validation.choice(f"{_NAME}: {_END}", own.pop(_END, _ENDS[0]), _ENDS) == _ENDS[1]
    validation.keys("entry of schedule", own, names)
    stacks, lengths = {}, {}
    for name, value in own.items():
        if plain_options(getattr(options, name)) != plain_options(getattr(type(options), name)):
            raise refusal(name, getattr(options, name), "left out with the schedule's")
        single = not name.startswith(_OF_SENSORS)
        field, kind = f"{_NAME}: {name}", "a stack"
        stacks[name] = single, [value] if single else validation.entries(field, value, kind)
        lengths[name] = [_steps(field, stack) for stack in stacks[name][1]]
    every = set().union(*lengths.values())
    if len(every) != 1:
        allowed = f"one or more stacks of {', '.join(names)}, all of one length"
        raise forbidden(_NAME, schedule, f"it must be {allowed}, not {lengths}")
    (steps,) = every

    def options_at(step: int) -> Any:
        values = {
            name: parts[0][step] if single else [part[step] for part in parts]
            for name, (single, parts) in stacks.items()
        }
        return SimpleNamespace(**vars(options) | values)

    pairs = [(step, step - 1 if step or not hold else 0) for step in range(steps)]
    rows = []
    # A schedule that holds has the last step twice, because its second use has another predecessor.
    for step, before in [*pairs, *([(steps - 1, steps - 1)] if hold else [])]:
        try:
            rows.append(build(options_at(step), options_at(before)))
        except ConfigurationError as error:
            raise ConfigurationError(f"{_NAME} at step {step}: {error}") from None
    return [_joined(parts, hold) for parts in zip(*rows, strict=True)]


def _steps(field: str, stack: Any) -> int:
    """Return the length of a stack whose entries have one shape."""
    entries = validation.entries(field, stack, "an array", "step")
    first = validation.array_shape(entries[0])
    for step, entry in enumerate(entries):
        if validation.array_shape(entry) != first:
            raise refusal(f"{field} at step {step}", entry, f"an array of shape {first}")
    return len(entries)


def _joined(parts: Sequence[Any], hold: bool) -> Any:
    """Return the part of the first step with a schedule of the fields that vary."""
    stacks = {}
    for item in fields(parts[0]):
        values = [getattr(part, item.name) for part in parts]
        if item.name == _FACTOR:  # of any rank
            most = max(value.shape[1] for value in values)
            values = [np.pad(v, [(0, 0), (0, most - v.shape[1]), (0, 0)]) for v in values]
        if isinstance(values[0], np.ndarray):
            stack = np.concatenate(values, axis=-1)
            if (stack != stack[..., :1]).any():
                stacks[item.name] = stack
    schedule = MatrixSchedule(stacks, len(parts), hold)
    first = {name: stack[..., :1] for name, stack in stacks.items()}
    return replace(parts[0], **first, schedule=schedule if stacks else None)
