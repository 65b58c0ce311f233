"""What a fusion rule makes of two estimates, as ellipses of one standard deviation."""

import io

import numpy as np

from fusion_gym.agents.output import palette
from fusion_gym.agents.output.palette import plt
from fusion_gym.fusion.table import RULES
from website.parts import Part

FIRST = np.array([[4.0, 1.2], [1.2, 1.0]])
SECOND = np.array([[1.0, -0.5], [-0.5, 3.0]])
MEANS = np.array([[0.0, 0.0], [0.7, 0.5]])
SHARED = 0.5  # of each estimate's error, as a correlation of the whitened errors


def drawn(part: Part) -> tuple[bytes, str]:
    """The figure of a fusion rule as SVG, and its caption."""
    joint, rule = _joint(), RULES[part.name]
    values = joint if rule.assumes == "joint covariance" else np.stack((FIRST, SECOND))
    fused = rule.make().fuse(MEANS[..., None], values[..., None])
    gains, claimed = fused.gains[..., 0], fused.covariance[..., 0]
    actual = sum(gains[i] @ joint[i, j] @ gains[j].T for i in range(2) for j in range(2))
    with plt.rc_context({**palette.LARGE, "svg.fonttype": "path"}):
        figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
        for covariance, mean, colour, line, label in (
            (FIRST, MEANS[0], palette.GREY, "-", "the two estimates"),
            (SECOND, MEANS[1], palette.GREY, "-", None),
            (claimed, fused.mean[:, 0], palette.RULES_MEMORY.colour, "-", "fused, as claimed"),
            (actual, fused.mean[:, 0], palette.AGENTS_MEMORY.colour, "--", "fused, actual"),
        ):
            angle = np.linspace(0.0, 2.0 * np.pi, 200)
            circle = np.stack((np.cos(angle), np.sin(angle)))
            x, y = mean[:, None] + np.linalg.cholesky(covariance) @ circle
            axes.plot(x, y, line, color=colour, lw=3, label=label)
        axes.set(xlabel="state 1 (unit of the state)", ylabel="state 2 (unit)")
        axes.set_aspect("equal")
        figure.legend(loc="outside right upper")
        image = io.BytesIO()
        figure.savefig(image, format="svg", metadata={"Date": None})
        plt.close(figure)
    holds = bool(np.linalg.eigvalsh(claimed - actual).min() > -1e-9)
    return image.getvalue(), _caption(
        part.name, holds, float(np.trace(claimed)), float(np.trace(actual))
    )


def _joint() -> np.ndarray:
    """Joint covariance (2, 2, n, n) of two errors that have a part in common."""
    first, two = np.linalg.cholesky(FIRST), np.linalg.cholesky(SECOND)
    cross = SHARED * first @ two.T
    return np.array([[FIRST, cross], [cross.T, SECOND]])


def _caption(name: str, holds: bool, claimed: float, actual: float) -> str:
    verdict = (
        "The claim covers the actual ellipse."
        if holds
        else "The claim is too small: the actual ellipse sticks out, for the errors are correlated."
    )
    return (
        f"Two estimates whose errors are correlated by {SHARED:g}, joined by {name}: ellipses of "
        f"one standard deviation. Claimed trace {claimed:.3g}, actual {actual:.3g}. {verdict}"
    )
