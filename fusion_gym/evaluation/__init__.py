"""Evaluation: paired episodes, metrics with confidence intervals, the lower envelope."""

from fusion_gym.evaluation.episodes import (
    EpisodeResults,
    Trajectory,
    record_episode,
    run_episodes,
    watch,
)
from fusion_gym.evaluation.metrics import (
    EnvelopePoint,
    Interval,
    envelope_error,
    lower_envelope,
    mean_interval,
    paired_difference,
    robust_summary,
    summarise,
)
from fusion_gym.policies.registry import make_policy

__all__ = [
    "EnvelopePoint",
    "EpisodeResults",
    "Interval",
    "Trajectory",
    "envelope_error",
    "lower_envelope",
    "make_policy",
    "mean_interval",
    "paired_difference",
    "record_episode",
    "robust_summary",
    "run_episodes",
    "summarise",
    "watch",
]
