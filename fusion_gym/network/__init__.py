"""Network: which requests are granted."""

from fusion_gym.network.token_bucket import SHARING_RULES, Grants, TokenBucket

__all__ = ["SHARING_RULES", "Grants", "TokenBucket"]
