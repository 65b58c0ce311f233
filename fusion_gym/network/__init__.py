"""Network: which requests are granted."""

from fusion_gym.network.access import ACCESS_RULES, access_mask, first_request
from fusion_gym.network.channel import Channel
from fusion_gym.network.token_bucket import SHARING_RULES, Grants, TokenBucket

__all__ = [
    "ACCESS_RULES",
    "SHARING_RULES",
    "Channel",
    "Grants",
    "TokenBucket",
    "access_mask",
    "first_request",
]
