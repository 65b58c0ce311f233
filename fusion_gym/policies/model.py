"""A saved Stable-Baselines3 agent as a policy.

Loading a model unpickles parts of the file: load only files that you trust.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from fusion_gym import validation
from fusion_gym.core.reward import Price
from fusion_gym.core.system import Knowledge, Signals, least_covering
from fusion_gym.core.task import ACTION_KINDS, Task
from fusion_gym.envs.views import make_view
from fusion_gym.policies.base import Requests
from fusion_gym.validation import ConfigurationError

# Every algorithm of both libraries by its name in configs and saved models: MaskablePPO is
# "maskable_ppo".
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower(): kind
    for library in (stable_baselines3, sb3_contrib)
    for name, kind in vars(library).items()
    if isinstance(kind, type) and issubclass(kind, BaseAlgorithm)
}
_TAG = "fusion_gym_model"


def tag_model(model: BaseAlgorithm, task: Task, local: bool = False) -> None:
    """Write algorithm and observation layout into the model, to be saved with it.

    ``local`` marks a policy that every sensor runs on its own view.
    """
    names = make_view(task, local).names
    algorithm = next(name for name, kind in ALGORITHMS.items() if type(model) is kind)
    tag = {
        "algorithm": algorithm,
        "observation_names": list(names),
        "local": local,
        "price_range": task.reward.price.span,
    }
    setattr(model, _TAG, tag)


class ModelPolicy:
    """Asks a Stable-Baselines3 model, which sees the task's observation and nothing else.

    A model that was trained to see the price of a token (``price_range``) can be asked for any
    point of its trade-off: ``price`` stands for the task's own price, whether or not the task
    shows it. With ``local`` every sensor asks the model by itself, about its own view.

    Raises:
        ConfigurationError: a price for a model that knows none, or outside its range.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        task: Task,
        deterministic: bool = True,
        price: float | None = None,
        local: bool = False,
        price_range: tuple[float, float] | None = None,
    ) -> None:
        self.model = model
        self.deterministic = deterministic
        self._shown = task.reward.price.span is not None
        self._task = _priced(task, price_range)
        self._view = make_view(self._task, local)
        self._memory: Any = None  # of a recurrent policy
        self.knowledge: Knowledge = self._view.knowledge
        if isinstance(model, RecurrentPPO) and self.knowledge != "centre":
            self.knowledge = least_covering((self.knowledge, "own_memory"))
        span = self._task.reward.price.span
        self._price: float | None = None  # as the model sees it, in place of the task's own
        if price is None and span is not None and not self._shown:
            fixed = task.reward.price.fixed
            assert fixed is not None  # a drawn price is always shown
            price = min(max(fixed, span[0]), span[1])
        if price is not None:
            if span is None:
                raise ConfigurationError(
                    f"price = {price!r} is not allowed: the model was trained without a "
                    "price_range, for one price alone"
                )
            chosen = Price.create(price, span)
            self._price = float(chosen.encode(chosen.draw(np.zeros(1)))[0])

    def reset(self, runs: int, seed: int = 0) -> None:
        """Forget the memory of a recurrent policy; draw from the stream of ``seed``."""
        self._memory = None
        if not self.deterministic:
            self.model.set_random_seed(seed)

    def __call__(self, signals: Signals) -> Requests:
        """Requests (sensors, N)."""
        observation = signals["observation"]
        if self._price is not None:
            own = observation[:, :-1] if self._shown else observation  # the price comes last
            column = np.full((len(own), 1), self._price, dtype=np.float32)
            observation = np.concatenate((own, column), axis=1)
        masks = {}
        if isinstance(self.model, MaskablePPO):
            masks["action_masks"] = self._view.masks(signals["grantable"])
        action, self._memory = self.model.predict(
            self._view.rows(observation),
            state=self._memory,
            episode_start=signals["start"].repeat(self._view.rows_per_run),
            deterministic=self.deterministic,
            **masks,
        )
        return self._view.requests(action, len(observation))


def _priced(task: Task, price_range: tuple[float, float] | None) -> Task:
    """The task with the price in its observation, if the model saw one and the task shows none."""
    if price_range is None or task.reward.price.span is not None:
        return task
    price = Price(None, (price_range[0], price_range[1]))
    return dataclasses.replace(task, reward=dataclasses.replace(task.reward, price=price))


def load_model_policy(
    path: str, task: Task, deterministic: bool = True, price: float | None = None
) -> ModelPolicy:
    """The agent saved at ``path`` (with or without ``.zip``), checked against the task.

    Raises:
        ConfigurationError: no such file, no Stable-Baselines3 model of a known algorithm, or a
            model of another observation layout or action space.
    """
    validation.boolean("deterministic", deterministic)
    file = next((p for p in (Path(path), Path(f"{path}.zip")) if p.is_file()), None)
    if file is None:
        raise ConfigurationError(f"model {path!r} is not allowed: there is no such file")
    try:
        data, _, _ = load_from_zip_file(file, device="cpu", load_data=True)
    except Exception as error:
        raise ConfigurationError(
            f"model {path!r} is not allowed: it is no Stable-Baselines3 model ({error})"
        ) from None
    if not data or "observation_space" not in data:
        raise ConfigurationError(f"model {path!r} is not allowed: it has no observation space")
    tag = data.get(_TAG, {})
    local, price_range = bool(tag.get("local")), tag.get("price_range")
    kind = _fitted(path, data, _priced(task, price_range), local).action
    task = dataclasses.replace(task, action=kind)
    return ModelPolicy(_load(path, file, data), task, deterministic, price, local, price_range)


def _fitted(path: str, data: dict[str, Any], task: Task, local: bool) -> Task:
    """The task with the kind of action that the model has, its observation layout checked."""
    view = make_view(task, local)
    names = data.get(_TAG, {}).get("observation_names")
    if names is not None and list(names) != list(view.names):
        missing = [name for name in names if name not in view.names]
        extra = [name for name in view.names if name not in names]
        raise ConfigurationError(
            f"model {path!r} was trained for another observation layout: it expects {len(names)} "
            f"entries, the task (information={task.information!r}) has {len(view.names)}; "
            f"missing are {missing[:4] or 'none'}, unknown to the model {extra[:4] or 'none'}"
            + ("" if missing or extra else " (the order differs)")
        )
    wanted = view.space
    have = data["observation_space"]
    if have.shape != wanted.shape:
        raise ConfigurationError(
            f"model {path!r} was trained for another observation layout: it expects shape "
            f"{have.shape}, the task (information={task.information!r}) has {wanted.shape}"
        )
    if local:
        return task
    action = data["action_space"]
    kinds = (
        [task]
        if task.access == "single"
        else [dataclasses.replace(task, action=kind) for kind in ACTION_KINDS]
    )
    allowed = [make_view(kind).actions for kind in kinds]
    if action not in allowed:
        raise ConfigurationError(
            f"model {path!r} has the action space {action}: the task has {task.sensors} sensors, "
            f"so it must be {' or '.join(map(str, allowed))}"
        )
    return kinds[allowed.index(action)]


def _load(path: str, file: Path, data: dict[str, Any]) -> BaseAlgorithm:
    """Load with the algorithm that the file names, or the one that its policy class fits."""
    tagged = data.get(_TAG, {}).get("algorithm")
    if tagged in ALGORITHMS:
        candidates = [tagged]
    elif "q_net" in str(data) or "exploration_schedule" in data:
        candidates = ["dqn"]
    else:
        candidates = ["ppo", "a2c"]
    problems = []
    for name in candidates:
        try:
            return ALGORITHMS[name].load(file, device="cpu")
        except Exception as error:
            problems.append(f"{name}: {error}")
    raise ConfigurationError(
        f"model {path!r} cannot be loaded as {' or '.join(candidates)} ({'; '.join(problems)})"
    )
