"""Draws docs/pictures/step.svg and step.png: how one step works.

python -m website.step_picture
"""

from typing import Any

from fusion_gym.agents.output import palette
from fusion_gym.agents.output.palette import plt
from website.places import DOCS

# Column, row from above, heading, text, colour of the frame.
_BOXES = {
    "plant": (0, 0, "plant", "x moves\nwith noise", palette.INK),
    "sensors": (1, 0, "sensors", "each measures a part:\ncensored, faded, late", palette.INK),
    "signals": (2, 0, "signals", "what may be\nlooked at", palette.INK),
    "policy": (2, 1, "policy", "which sensors\nrequest?", palette.AGENT),
    "network": (2, 2, "network", "grants: tokens,\naccess, losses", palette.INK),
    "nodes": (1, 2, "local filters", "update with what\ngot through", palette.INK),
    "centre": (0, 2, "fusion centre", "joins estimates\nto x̂, P", palette.INK),
    "reward": (0, 1, "reward", "−(error of x̂\n+ price · tokens)", palette.INK),
}
_ARROWS = (
    ("plant", "sensors", ""),
    ("sensors", "signals", ""),
    ("signals", "policy", "observation"),
    ("policy", "network", "action"),
    ("network", "nodes", ""),
    ("nodes", "centre", ""),
    ("centre", "reward", ""),
    ("reward", "plant", "t + 1"),
)
_WIDTH, _HEIGHT, _COLUMN, _ROW = 2.75, 1.25, 3.45, 2.05


def draw() -> None:
    """Write both files."""
    with plt.rc_context({"svg.hashsalt": "fusion-gym", "font.size": 15, "svg.fonttype": "path"}):
        figure, axes = plt.subplots(figsize=(9.6, 5.6), layout="constrained", dpi=100)
        axes.axis("off")
        axes.set(xlim=(-1.5, 2 * _COLUMN + 1.5), ylim=(-2 * _ROW - 1.45, 0.8))
        axes.set_aspect("equal")
        for box in _BOXES.values():
            _box(axes, *box)
        for first, last, word in _ARROWS:
            _arrow(axes, first, last, word)
        _feedback(axes)
        axes.text(
            _COLUMN, -_ROW, "sense: first row\ndecide: policy\ndeliver: last row",
            ha="center", va="center", color="0.35", style="italic", linespacing=1.5,
        )  # fmt: skip
        folder = DOCS / "pictures"
        folder.mkdir(exist_ok=True)
        figure.savefig(folder / "step.svg", metadata={"Date": None})
        figure.savefig(folder / "step.png", metadata={"Software": None}, dpi=130)
        plt.close(figure)


def _place(name: str) -> tuple[float, float]:
    column, row = _BOXES[name][:2]
    return column * _COLUMN, -row * _ROW


def _box(axes: Any, column: int, row: int, heading: str, text: str, colour: str) -> None:
    from matplotlib.patches import FancyBboxPatch

    x, y = column * _COLUMN, -row * _ROW
    corner = (x - _WIDTH / 2, y - _HEIGHT / 2)
    axes.add_patch(
        FancyBboxPatch(
            corner, _WIDTH, _HEIGHT, boxstyle="round,pad=0,rounding_size=0.12",
            facecolor="white", edgecolor=colour, linewidth=2.5,
        )
    )  # fmt: skip
    axes.text(x, y + 0.33, heading, ha="center", va="center", weight="bold", color=colour)
    axes.text(x, y - 0.22, text, ha="center", va="center", fontsize=13, color=palette.INK)


def _arrow(axes: Any, first: str, last: str, word: str) -> None:
    (x0, y0), (x1, y1) = _place(first), _place(last)
    if y0 == y1:
        step = (_WIDTH / 2) * (1 if x1 > x0 else -1)
        ends = (x0 + step, y0), (x1 - step, y1)
    else:
        rise = (_HEIGHT / 2) * (1 if y1 > y0 else -1)
        ends = (x0, y0 + rise), (x1, y1 - rise)
    style = {"arrowstyle": "-|>", "lw": 2, "color": palette.INK, "mutation_scale": 18}
    axes.annotate("", ends[1], ends[0], arrowprops={**style, "shrinkA": 0, "shrinkB": 0})
    if word:
        middle = (ends[0][1] + ends[1][1]) / 2
        axes.text(x0 + 0.15, middle, word, ha="left", va="center", fontsize=13, color="0.35")


def _feedback(axes: Any) -> None:
    """From the centre below the row back to the filters, where a system has that."""
    low = -2 * _ROW - _HEIGHT / 2
    style = {"arrowstyle": "-|>", "lw": 1.6, "color": "0.45", "ls": "--", "mutation_scale": 16}
    style |= {"connectionstyle": "arc3,rad=0.35", "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (_COLUMN - 0.6, low), (0.4, low), arrowprops=style)
    axes.text(_COLUMN / 2, low - 0.5, "feedback", ha="center", va="top", fontsize=13, color="0.35")


if __name__ == "__main__":
    draw()
