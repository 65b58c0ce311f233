"""The contract of a controller, which closes the loop from the estimate to the plant."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array


class Controller(ABC):
    """Define the input u of a plant as a function of the fused estimate, and the cost of the loop.

    The input follows every delivery and acts until the next sensing; a late packet affects inputs
    from its arrival on. It is broadcast to every node without charge. The plant's ``sense`` and the
    estimator's ``predict`` take it as a further argument ``control`` (k, N).

    Attributes:
        error_weights: M (n, n) if the mean cost is the mean of eᵀMe, with e the estimation error,
            plus a part that no policy changes; ``None`` if there is no such matrix.
        traceable: Whether JAX traces the methods, so that compiled code and JAX run them, too.

    Example:
        >>> import numpy as np
        >>> import fusion_gym
        >>> task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", input_matrix=[[0.0], [1.0]])
        >>> task.controller.act(np.zeros((2, 4))).shape
        (1, 4)
    """

    error_weights: Array | None = None
    traceable: bool = False

    @abstractmethod
    def act(self, mean: Array) -> Array:
        """Return the input (k, N).

        Args:
            mean: Fused estimate (n, N).
        """

    @abstractmethod
    def cost(self, state: Any, control: Array) -> Array:
        """Return the cost (N,) of a step, >= 0.

        Args:
            state: State of the plant; :meth:`~fusion_gym.Plant.truth` has its numbers (n, N).
            control: Input (k, N).
        """

    def terminal_cost(self, state: Any) -> Array | None:
        """Return the cost (N,) of the state at the end of an episode; ``None`` is zero.

        Args:
            state: State of the plant.
        """
        return None

    def terminated(self, state: Any) -> NDArray[np.bool_] | None:
        """Return the runs (N,) whose episode ends, and which stay ended; ``None`` is never.

        The step that ends a run is also charged for each step that is left.

        Args:
            state: State of the plant.
        """
        return None

    def forfeit(self, state: Any) -> Array | None:
        """Return the cost (N,) of each step that is left after an end; ``None`` is the last cost.

        Args:
            state: State of the plant.
        """
        return None


def inputs_of(control: Array | None) -> tuple[Any, ...]:
    """Return the further arguments of ``sense`` and ``predict``: the input, if there is one."""
    return () if control is None else (control,)


def control_of(task: Any, plant: Any, estimate: Any) -> Array | None:
    """Return the input (k, N) after a delivery, zero in runs that are over."""
    if task.controller is None:
        return None
    control: Array = task.controller.act(task.estimator.mean(estimate))
    over = over_of(task, plant)
    return control if over is None else np.where(over, 0.0, control)


def over_of(task: Any, plant: Any) -> NDArray[np.bool_] | None:
    """Return the runs (N,) that have ended in a state of the plant."""
    return None if task.controller is None else task.controller.terminated(plant)
