"""Training to a given average rate: a Lagrange multiplier on the tokens spent."""

import math
from typing import Any

from fusion_gym.training.callback import Callback

STEP = 0.05  # of the multiplier's logarithm, for a rate that is twice the target
LIMITS = (1e-6, 1e6)  # the multiplier stays within these factors of where it began
TOLERANCE = 1.03  # a rate counts as kept up to this factor of the target


class TargetRate(Callback):
    """Raises the price of a token while more is sent than ``target``, and lowers it otherwise.

    After each stretch of data the price λ becomes λ exp(step (rate/target - 1)): dual ascent on
    E[error] + λ (E[tokens spent] - budget), in the logarithm, so that λ stays positive. ``target``
    and rate are tokens spent over the tokens that transmitting always would spend: with equal
    costs, transmissions per sensor and step. λ is the model's ``token_price``, and so part of
    every checkpoint.
    """

    def __init__(self, target: float, start: float) -> None:
        super().__init__()
        self.target = target
        self.start = start
        self._mark = (0.0, 0)

    def _on_training_start(self) -> None:
        if getattr(self.model, "token_price", None) is None:
            self.model.token_price = self.start  # type: ignore[attr-defined]
        self.environment.set_price(self.price)
        self._mark = self.environment.totals

    @property
    def price(self) -> float:
        """The present multiplier, in reward per token."""
        return float(self.model.token_price)  # type: ignore[attr-defined]

    def _on_rollout_end(self) -> None:
        env = self.environment
        spent, steps = env.totals
        if steps <= self._mark[1]:
            return
        always = float(env.task.bucket.cost.sum())
        rate = (spent - self._mark[0]) / (steps - self._mark[1]) / always
        self._mark = (spent, steps)
        change = STEP * min(rate / self.target - 1.0, 1.0)
        price = self.price * math.exp(change)
        low, high = (limit * self.start for limit in LIMITS)
        self.model.token_price = min(max(price, low), high)  # type: ignore[attr-defined]
        env.set_price(self.price)
        self.logger.record("constraint/token_price", self.price)
        self.logger.record("constraint/rate", rate)


def rate_score(record: dict[str, Any], target: float | None) -> tuple[float, float]:
    """What the best model has most of: return, or with a target its rate kept, then its return."""
    if target is None:
        return 0.0, record["return"]
    excess = record["rate"] / target - TOLERANCE
    return -max(excess, 0.0), record["return"]
