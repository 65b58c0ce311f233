"""Verdicts about curves: one below another at every step, an estimate that tracks."""

from collections.abc import Sequence

from fusion_gym.arrays import Array

from ..piece_result import Verdict

_CLEAR = 4.0  # standard errors: of 200 comparisons without a difference none is likely to reach it
_MOST = 0.5  # share of the points


def always_below(difference: Array) -> tuple[Verdict, str]:
    """Whether one curve lies below another at every step, and how often it does.

    ``difference`` (2, H, …) is the mean of the paired differences of squared errors with its
    standard error. It holds if no point has the other order by more than chance and more than half
    of them have this one clearly; partly if more have this one clearly than the other.
    """
    mean, error = difference
    lower = (mean < -_CLEAR * error) & (error > 0)
    higher = (mean > _CLEAR * error) & (error > 0)
    words = (
        f"clearly lower at {lower.sum()} of {mean.size} points, clearly higher at {higher.sum()}, "
        f"lower by the mean at {(mean < 0).sum()}"
    )
    if not higher.any() and lower.mean() > _MOST:
        return "holds", words
    return ("holds partly" if lower.sum() > higher.sum() else "does not hold"), words


def explained(armse: Sequence[float], silent: Sequence[float]) -> list[float]:
    """Shares of the open-loop variance that an estimate explains, a state each."""
    return [1.0 - (first / none) ** 2 for first, none in zip(armse, silent, strict=True)]


def list_numbers(values: Sequence[float], form: str = ".3g") -> str:
    """Numbers side by side."""
    return ", ".join(format(value, form) for value in values)
