"""Verdicts of the papers that are not converted yet."""

from ..papers.numbers import below, cite, estimate, percent, verdict

__all__ = ["below", "cite", "estimate", "percent", "verdict"]
