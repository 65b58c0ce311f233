"""The exact unbiased input-state filter where a measurement arrives, prediction where none does."""

from __future__ import annotations

from dataclasses import dataclass

from fusion_gym.filters.input_state import InputModel, JointGain
from fusion_gym.validation import Array


@dataclass(frozen=True)
class ExactInputStateFilter:
    """Unbiased minimum-variance estimates of state and input from the latest measurement.

    An update assumes nothing about the input that has just acted: its estimate comes from this
    measurement alone. While every measurement arrives the covariance is therefore the actual one,
    for every input. Where none arrives there is nothing to estimate the input from, and the node
    predicts with the :class:`InputModel`; from then on its covariance is a claim that is as good
    as the model.

    Source: S. Gillijns and B. De Moor, "Unbiased minimum-variance input and state estimation for
    linear discrete-time systems", Automatica 43, 2007; unknown_input, equations (8)-(16) with
    every measurement sent.
    """

    model: InputModel
    joint: JointGain

    def update(self, posterior: Array, noise: Array) -> tuple[Array, Array]:
        """Gain (l, s, m, N) and covariance (l, s, s, N) from the posterior one instant earlier.

        ``posterior`` is (l, s, s, N), ``noise`` (l, m, m, 1) the covariance of the measurements.
        The gain hides the input, so it may be applied to y - C x̂ with any prediction of the input
        in x̂: the updated estimate is the same.
        """
        before = self.model.without_input(posterior)
        gain = self.joint.gain(before, noise)
        return gain, self.joint.covariance(gain, before, noise)
