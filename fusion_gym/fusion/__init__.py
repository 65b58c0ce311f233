"""Fusion rules: how the centre joins the nodes' estimates."""

from fusion_gym.fusion.covariance_intersection import (
    Fused,
    covariance_intersection,
    covariance_intersection_many,
    inverse_covariance_intersection,
)
from fusion_gym.fusion.federated import FederatedFusion
from fusion_gym.fusion.feedback import INTERSECTION_RULES, FeedbackFusion, IntersectionFusion
from fusion_gym.fusion.information import InformationFusion
from fusion_gym.fusion.matrix_weighted import IntersectionOfCopies, MatrixWeightedFusion
from fusion_gym.fusion.parallel import ParallelFusion
from fusion_gym.fusion.sequential import SequentialFusion, SequentialResult

__all__ = [
    "INTERSECTION_RULES",
    "FederatedFusion",
    "FeedbackFusion",
    "Fused",
    "InformationFusion",
    "IntersectionFusion",
    "IntersectionOfCopies",
    "MatrixWeightedFusion",
    "ParallelFusion",
    "SequentialFusion",
    "SequentialResult",
    "covariance_intersection",
    "covariance_intersection_many",
    "inverse_covariance_intersection",
]
