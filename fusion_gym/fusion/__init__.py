"""Fusion rules: how the centre joins the nodes' estimates."""

from fusion_gym.fusion.federated import FederatedFusion

__all__ = ["FederatedFusion"]
