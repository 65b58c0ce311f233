"""Federated fusion against its formula, and against the centralised Kalman filter."""

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter as FilterPyFilter
from parts import Parts

from fusion_gym import ConfigurationError
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.tobit.centres import FederatedCentre, information_shares
from fusion_gym.systems.tobit.filters import KalmanFilter, TobitKalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.system import CensoredEstimator, CensoredPlant

UNEQUAL = (0.5, 0.3, 0.2)
MATRICES = np.array([[[1.0, 0.0], [0.3, 1.0]], [[0.0, 1.0], [1.0, -1.0]], [[1.0, 2.0], [0.0, 0.5]]])
VARIANCES = np.array([[0.5, 0.2], [1.0, 0.1], [0.3, 2.0]])
TRANSITION = np.array([[0.9, 0.4], [-0.4, 0.9]])
PROCESS = np.outer([0.3, 0.1], [0.3, 0.1])  # rank one


def make_parts(kind: Any, share: Any) -> Parts:
    """Uncensored sensors that all differ, and a process covariance without an inverse."""
    dynamics = LinearPlant.create(TRANSITION, PROCESS, [2.0, -1.0], 0.4 * np.eye(2))
    sensors = CensoredSensors.create(MATRICES, VARIANCES, -np.inf, 2)
    centre = FederatedCentre(kind(sensors), information_shares(share, 3))
    names, ones = ("x1", "x2"), np.ones(2)
    plant = CensoredPlant(dynamics, sensors, names)
    return Parts(plant, CensoredEstimator(dynamics, centre, names, scale=ones, reference=ones))


@pytest.mark.parametrize("kind", [KalmanFilter, TobitKalmanFilter])
@pytest.mark.parametrize("share", [None, UNEQUAL, (0.01, 0.01, 0.98)])
@pytest.mark.parametrize("arrival", ["all", "some"])
def test_uncensored_federation_is_the_centralised_kalman_filter(
    kind: Any, share: Any, arrival: str
) -> None:
    """Whoever delivers, and however the information is shared: the centre loses nothing."""
    parts, runs, steps = make_parts(kind, share), 4, 40
    generator = np.random.default_rng(6)
    state = parts.start(generator.normal(size=(parts.plant.start_channels, runs)))
    central = []
    for _ in range(runs):
        other = FilterPyFilter(dim_x=2, dim_z=6)
        other.x, other.P = np.array([[2.0], [-1.0]]), 0.4 * np.eye(2)
        other.F, other.Q = TRANSITION, PROCESS
        central.append(other)
    for _ in range(steps):
        state = parts.sense(state, generator.normal(size=(parts.plant.noise_channels, runs)))
        granted = np.ones((3, runs), dtype=np.bool_)
        if arrival == "some":
            granted = generator.random((3, runs)) < 0.5
        state = parts.deliver(state, granted)
        mean, covariance = parts.fused(state)
        for run, other in enumerate(central):
            other.predict()
            mask = granted[:, run]
            if mask.any():
                other.update(
                    state.plant.measurement[mask, :, run].reshape(-1, 1),
                    R=np.diag(VARIANCES[mask].ravel()),
                    H=MATRICES[mask].reshape(-1, 2),
                )
            np.testing.assert_allclose(mean[:, run], other.x[:, 0], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(covariance[..., run], other.P, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(
    ("share", "reason"),
    [((0.5, 0.3, 0.3), "sum 1"), ((1.2, -0.1, -0.1), "> 0"), ((0.5, 0.5), "shape")],
)
def test_bad_shares_are_refused(share: Any, reason: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        information_shares(share, 3)
    message = str(refused.value)
    assert message.startswith("information_shares = ")
    assert reason in message
    assert str(np.ravel(share)[0]) in message
