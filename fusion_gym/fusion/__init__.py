"""Fusion rules: how the centre joins the nodes' estimates."""

from fusion_gym.fusion.covariance_intersection import (
    Fused,
    covariance_intersection,
    covariance_intersection_many,
    inverse_covariance_intersection,
)
from fusion_gym.fusion.federated import FederatedFusion
from fusion_gym.fusion.information import InformationFusion
from fusion_gym.fusion.sequential import SequentialFusion, SequentialResult

__all__ = [
    "FederatedFusion",
    "Fused",
    "InformationFusion",
    "SequentialFusion",
    "SequentialResult",
    "covariance_intersection",
    "covariance_intersection_many",
    "inverse_covariance_intersection",
]
