"""The alternatives of a decision for a learner: probabilities, requests and values."""

from typing import Any, Literal

import numpy as np
import torch
from gymnasium.spaces import MultiBinary
from numpy.typing import NDArray

from fusion_gym.arrays import Array
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.envs.views import SensorView
from fusion_gym.validation import ConfigurationError

Kind = Literal["all", "flips"]
MOST_ALTERNATIVES = 8  # largest number of sets of requests for the default "all"
MOST_SENSORS = 10  # largest number of sensors for "all"
Choices = NDArray[np.int64]  # choices (runs, D)


class Decisions:
    """The alternatives of every run's decision, as D factors of C choices each.

    - ``"all"``: one factor, whose choices are all actions of a scheduler.
    - ``"flips"``: one factor per sensor, silence or a request, with the other sensors unchanged;
      also for local decisions.

    Args:
        env: the environment.
        kind: kind of alternatives; None for the default.

    Raises:
        ConfigurationError: flips of an action that is one number, or all sets of more than 10
            sensors.
    """

    def __init__(self, env: PrivilegedVecEnv, kind: Kind | None) -> None:
        self.view, self.local = env.view, isinstance(env.view, SensorView)
        self.sensors, self.runs = env.task.sensors, env.runs
        space = env.action_space
        self.binary = isinstance(space, MultiBinary)
        if self.local:
            self.kind: Kind = "flips"
        elif not self.binary:
            self.kind = "all"
        else:
            few = self.sensors < 60 and 2**self.sensors <= MOST_ALTERNATIVES
            self.kind = kind or ("all" if few else "flips")
        if kind is not None and kind != self.kind:
            raise ConfigurationError(
                f"alternatives = {kind!r} is not allowed here: it must be {self.kind!r}, because "
                + ("sensors decide locally" if self.local else "an action is one number")
            )
        self.choices = 2
        if self.kind == "all":
            self.choices = 2**self.sensors if self.binary else int(space.n)  # type: ignore[attr-defined]
            if self.choices > 2**MOST_SENSORS:
                text, instead = "action = 'discrete'", "action must be 'binary'"
                if self.binary:
                    text, instead = "alternatives = 'all'", "it must be 'flips'"
                raise ConfigurationError(
                    f"{text} is not allowed here with {self.sensors} sensors: it steps all "
                    f"2^{self.sensors} sets of requests of at most {MOST_SENSORS} sensors; "
                    f"{instead}"
                )
            numbers = np.arange(self.choices)
            bits = (numbers[:, None] >> np.arange(self.sensors) & 1).astype(np.bool_)
            actions = bits if self.binary else numbers
            self.bits = torch.as_tensor(bits, dtype=torch.float32)
            self.requests = env.view.requests(actions, self.choices).T[:, :, None]

    def log_probabilities(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the log-probabilities of all choices (runs, D, C).

        Args:
            logits: for ``Discrete`` (runs, choices), for local decisions (runs, sensors, 2), for
                the requests of ``MultiBinary`` (runs, sensors).
        """
        if not self.binary:
            values = torch.log_softmax(logits, -1)
            return values if self.local else values[:, None]
        silent = -torch.nn.functional.softplus(logits)
        if self.kind == "flips":
            return torch.stack((silent, logits + silent), -1)
        return (silent.sum(-1, keepdim=True) + logits @ self.bits.T)[:, None]

    def by_run(self, rows: Any) -> Any:
        """Return local rows (rows, entries) by run (runs, sensors, entries); others unchanged."""
        return rows.reshape(-1, self.sensors, rows.shape[-1]) if self.local else rows

    def visible_rows(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the local views (runs, sensors, entries) of observations (runs, entries)."""
        return self.by_run(self.view.rows(observation))

    def actions(self, choice: Choices) -> NDArray[Any]:
        """Return the actions of the rows from the choices (runs, D)."""
        if not self.binary:
            return choice.reshape(-1)
        if self.kind == "flips":
            return choice
        return choice >> np.arange(self.sensors) & 1

    def alternatives(self, choice: Choices) -> NDArray[Any]:
        """Return the alternative requests (A, sensors, N) of the choices (runs, D)."""
        if self.kind == "all":
            return np.broadcast_to(self.requests, (self.choices, self.sensors, self.runs))
        taken = choice.T == 1
        return taken ^ np.eye(self.sensors, dtype=np.bool_)[:, :, None]

    def arranged(self, choice: Choices, taken: Array, stepped: Array) -> Array:
        """Return the values (runs, D, C) of all choices, from taken and stepped (A, runs) ones."""
        if self.kind == "all":
            return stepped.T[:, None]
        flipped = stepped.T
        rest = np.broadcast_to(taken[:, None], flipped.shape)
        request = choice == 1
        return np.stack((np.where(request, flipped, rest), np.where(request, rest, flipped)), -1)
