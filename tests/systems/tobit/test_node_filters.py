"""The expectation of the Tobit Kalman filter against quadrature."""

from typing import Any

import mpmath
import numpy as np
import pytest

from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import TobitKalmanFilter


@pytest.mark.parametrize("latent", [-4.0, -1.3, 0.0, 0.4, 2.5, 9.0])
@pytest.mark.parametrize("threshold", [-1.0, 0.0, 0.75])
@pytest.mark.parametrize("variance", [0.09, 0.5, 4.0])
def test_expectation_is_that_of_the_censored_normal(
    latent: float, threshold: float, variance: float
) -> None:
    sensors = CensoredSensors.create([[[2.0]]], variance, threshold, 1)
    expectation = TobitKalmanFilter(sensors).expect(np.array([[[latent / 2.0]]]))
    result = {name: float(value[0, 0, 0]) for name, value in expectation._asdict().items()}
    with mpmath.workdps(30):
        root = mpmath.sqrt(variance)
        nearest = mpmath.mpf(max(latent, threshold))
        ends = [nearest + root * step for step in (0, 0.1, 0.2, 0.4, 0.8, 1.6, 4, 20)]
        ends = [threshold, *ends] if threshold < latent else ends

        def beyond(power: int, about: Any) -> Any:
            """∫ over y > τ of (y - about)^power times the density."""
            return mpmath.quad(lambda y: (y - about) ** power * mpmath.npdf(y, latent, root), ends)

        inside, censored = beyond(0, 0), mpmath.ncdf(threshold, latent, root)
        mean = censored * threshold + beyond(1, 0)
        total_variance = censored * (threshold - mean) ** 2 + beyond(2, mean)
        truncated_mean = beyond(1, 0) / inside
        truncated_variance = beyond(2, truncated_mean) / inside
        expected = {
            "latent": latent,
            "uncensored_probability": float(inside),
            "value": float(mean),
            "noise_variance": float(total_variance),
            "hazard": float((truncated_mean - latent) / root),
            "truncated_variance": float(truncated_variance / variance),
        }
    assert result == pytest.approx(expected, rel=1e-8, abs=1e-14)
    assert result["uncensored_probability"] == pytest.approx(float(inside), rel=1e-9, abs=0.0)
