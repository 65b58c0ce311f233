"""Token buckets by their numbers."""

from typing import Any

from fusion_gym.core.token_bucket import BucketOptions, TokenBucket


def make_bucket(
    rate: Any,
    capacity: Any,
    initial: Any,
    cost: Any,
    sensors: int,
    sharing: Any = None,
    unlimited: bool = False,
    **options: Any,
) -> TokenBucket:
    """The bucket, shared equally by default."""
    own = options.get("budget") == "sensor"
    options |= {} if own else {"sharing": sharing or "equal"}
    options |= {"token_rate": rate, "token_capacity": capacity, "initial_tokens": initial}
    tokens: Any = "unlimited" if unlimited else "limited"
    return TokenBucket(BucketOptions(token_cost=cost, tokens=tokens, **options), sensors)
