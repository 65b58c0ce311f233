"""Figures 1 to 7 of the unknown-input paper, its example beside the well-posed one."""

from typing import Any

import numpy as np
from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullLocator

from ...output import palette
from ..judging import percent
from ..piece_result import Picture
from .filters import OURS
from .runs import CARTS, EXAMPLES, PRINTED, STEPS

_TIME = np.arange(1, STEPS + 1)
_TITLES = {PRINTED: "printed example", CARTS: "two carts"}
# Entries of [x; d] that stand for the paper's: what each is called, and its unit.
_STATES = {PRINTED: ((0, "$x^1$"), (1, "$x^2$")), CARTS: ((0, "cart 1 (m)"), (2, "cart 2 (m)"))}
_INPUTS = {PRINTED: ((2, "$d^1$"), (3, "$d^2$")), CARTS: ((4, "force (N)"),)}
_WALK = "Kalman filter, random-walk input"


def unknown_input_pictures(data: dict[str, Any]) -> list[Picture]:
    """All of them, in the paper's order."""
    return [
        _states(data),
        _inputs(data),
        *(_state_bound(data, place) for place in (0, 1)),
        _input_bounds(data),
        _input_trace(data),
        _instants(data),
    ]


def _curves(axis: Any, data: dict[str, Any], example: str, entry: int) -> None:
    """Truth, nodes, fused estimate and the Kalman filter; the fused and true values fill it."""
    truth, fused = (data[f"{example}_{name}"][:, entry] for name in ("truth", "fused"))
    local = data[f"{example}_local"][:, :, entry]
    axis.plot(_TIME, truth, color=palette.TRUTH, lw=3.2, label="true value")
    for node in range(local.shape[1]):
        colour, label = palette.SENSORS[node], f"node {node + 1}"
        axis.plot(_TIME, local[:, node], color=colour, lw=0.9, label=label)
    axis.plot(_TIME, fused, color=palette.FUSED, lw=1.8, label="fused")
    walk = data[f"{example}_walk"][:, entry]
    axis.plot(_TIME, walk, color=palette.GREEN, lw=1.3, label=_WALK)
    every = np.concatenate((truth, fused, walk))
    room = 0.15 * np.ptp(every)
    axis.set_ylim(every.min() - room, every.max() + room)


def _grid(figure: Any, rows: int) -> Any:
    axes = figure.subplots(rows, 2, sharex=True, squeeze=False)
    for column, example in enumerate(EXAMPLES):
        axes[0, column].set_title(_TITLES[example], loc="left")
        axes[-1, column].set_xlabel("sampling instant k")
        axes[-1, column].set_xlim(0, STEPS)
    return axes


def _legend(figure: Any, axes: Any, columns: int) -> None:
    """Over all axes, each label once: the truth, the fused estimate, the nodes, the rest."""
    data: dict[str, Any] = {}
    for axis in np.asarray(axes).ravel():
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            data.setdefault(label, handle)
    ranks = {"true value": 0, "fused": 1}
    order = sorted(data, key=lambda label: ranks.get(label, 2 if label[:4] == "node" else 3))
    handles = [data[label] for label in order]
    figure.legend(
        handles, order, loc="outside upper center", ncols=columns, fontsize=9, columnspacing=1.0
    )


def _root(data: dict[str, Any], name: str, example: str, block: int) -> float:
    value = data[f"{example}_{name}"]
    own = value[0, block] if name == "each" else value[block]
    return float(np.sqrt(own.mean()))


def _states(data: dict[str, Any]) -> Picture:
    def draw(figure: Any) -> None:
        axes = _grid(figure, 2)
        for column, example in enumerate(EXAMPLES):
            for row, (entry, label) in enumerate(_STATES[example]):
                _curves(axes[row, column], data, example, entry)
                axes[row, column].set_ylabel(label)
        _legend(figure, axes, 6)

    ratio = [_root(data, "each", e, 0) / _root(data, "power", e, 0) for e in EXAMPLES]
    return Picture(
        "figure_1",
        "Figure 1: states, their estimates by the nodes, and fused",
        "One run. The paper sees estimates on the true values. On its own example they are not: "
        f"the fused root mean square error is {ratio[0]:.1f} times that of the states themselves, "
        f"and node 1 leaves the picture; on the two carts it is {ratio[1]:.2f} times. A Kalman "
        "filter that takes the input for a random walk (green) tracks both with the same packets.",
        draw,
        (7.6, 5.0),
    )


def _inputs(data: dict[str, Any]) -> Picture:
    def draw(figure: Any) -> None:
        axes = _grid(figure, 2)
        for column, example in enumerate(EXAMPLES):
            for row, (entry, label) in enumerate(_INPUTS[example]):
                _curves(axes[row, column], data, example, entry)
                axes[row, column].set_ylabel(label)
        axes[1, 1].remove()
        axes[0, 1].tick_params(labelbottom=True)
        axes[0, 1].set_xlabel("sampling instant k")
        _legend(figure, [*axes[:, 0].tolist(), axes[0, 1]], 6)

    ratio = [_root(data, "each", e, 1) / _root(data, "power", e, 1) for e in EXAMPLES]
    return Picture(
        "figure_2",
        "Figure 2: unknown inputs and their estimates",
        "One run; an estimate at instant k is of the input that acted before it. On the printed "
        f"example the fused root mean square error is {ratio[0]:.0f} times the input's own root "
        f"mean square, so that the true input is a flat line; on the carts it is {ratio[1]:.2f} "
        "times, and the estimate follows the force.",
        draw,
        (7.6, 5.0),
    )


def _labels(data: dict[str, Any], example: str) -> list[tuple[str, str]]:
    nodes = data[f"{example}_square"].shape[1] - 1
    own = [(f"node {i + 1}", palette.SENSORS[i]) for i in range(nodes)]
    return [("fused", palette.FUSED), *own]


def _bounded(axis: Any, data: dict[str, Any], example: str, entries: list[int]) -> None:
    """Bounds solid, mean squared errors dotted, summed over the entries."""
    bound = data[f"{example}_bound"][..., entries].sum(-1)
    square = data[f"{example}_square"][..., entries].sum(-1)
    for place, (label, colour) in enumerate(_labels(data, example)):
        width = 2.2 if place == 0 else 1.3
        axis.plot(_TIME, bound[:, place], color=colour, lw=width, label=label)
        axis.plot(_TIME, square[:, place], ":", color=colour, lw=width)
    axis.set_yscale("log")


def _both(axis: Any) -> None:
    """Explain the two kinds of lines."""
    axis.plot([], [], "-", color=palette.INK, label="upper bound")
    axis.plot([], [], ":", color=palette.INK, label="MSE")


def _state_bound(data: dict[str, Any], place: int) -> Picture:
    def draw(figure: Any) -> None:
        axes = _grid(figure, 1)
        for column, example in enumerate(EXAMPLES):
            entry, label = _STATES[example][place]
            axis = axes[0, column]
            _bounded(axis, data, example, [entry])
            unit = " (m²)" if example == CARTS else ""
            axis.set_ylabel(f"{label.replace(' (m)', '')}: squared error{unit}")
        _both(axes[0, 1])
        _legend(figure, axes, 7)

    least = [_slack(data, e, _STATES[e][place][0]) for e in EXAMPLES]
    return Picture(
        f"figure_{3 + place}",
        f"Figure {3 + place}: upper bound and MSE of state $x^{1 + place}$".replace("$", ""),
        "Bounds that the filter computes (solid) and mean squared errors over all runs (dotted), "
        "of each node and fused. The MSE lies below its bound throughout, as in the paper; the "
        f"bound is {least[0]:.0f} times the fused MSE on average over the instants on the printed "
        f"example, {least[1]:.0f} times on the carts.",
        draw,
        (7.6, 3.6),
    )


def _slack(data: dict[str, Any], example: str, entry: int) -> float:
    ratio = data[f"{example}_bound"][:, 0, entry] / data[f"{example}_square"][:, 0, entry]
    return float(ratio.mean())


def _input_bounds(data: dict[str, Any]) -> Picture:
    def draw(figure: Any) -> None:
        axes = _grid(figure, 1)
        for column, example in enumerate(EXAMPLES):
            axis, bound = axes[0, column], data[f"{example}_bound"]
            for (entry, name), style in zip(_INPUTS[example], ("-", "--"), strict=False):
                for place, (label, colour) in enumerate(_labels(data, example)):
                    axis.plot(
                        _TIME, bound[:, place, entry], style, color=colour,
                        lw=2.2 if place == 0 else 1.3, label=label if style == "-" else None,
                    )  # fmt: skip
                if example == PRINTED:
                    axis.plot([], [], style, color=palette.INK, label=name)
            axis.set_yscale("log")
            axis.set_ylabel("bound" + (" (N²)" if example == CARTS else ""))
        axes[0, 1].yaxis.set_major_locator(FixedLocator([5.0, 7.0, 10.0, 14.0]))
        axes[0, 1].yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes[0, 1].yaxis.set_minor_locator(NullLocator())
        _legend(figure, axes, 7)

    level = float(np.sqrt(data[f"{PRINTED}_bound"][-1, 0, 2:].sum()))
    power = _root(data, "power", PRINTED, 1)
    return Picture(
        "figure_5",
        "Figure 5: upper bounds of the inputs",
        "What the filter claims of each input. On the printed example the fused bound allows a "
        f"root mean square error of {level:.0f}, {level / power:,.0f} times that of the inputs.",
        draw,
        (7.6, 3.6),
    )


def _input_trace(data: dict[str, Any]) -> Picture:
    def draw(figure: Any) -> None:
        axes = _grid(figure, 1)
        for column, example in enumerate(EXAMPLES):
            axis = axes[0, column]
            _bounded(axis, data, example, [entry for entry, _ in _INPUTS[example]])
            axis.set_ylabel("trace" + (" (N²)" if example == CARTS else ""))
        _both(axes[0, 1])
        _legend(figure, axes, 7)

    return Picture(
        "figure_6",
        "Figure 6: upper bound of the trace, and MSE, of the unknown inputs",
        "As Figures 3 and 4, summed over the inputs (the carts have one). The MSE lies below its "
        "bound throughout, as in the paper.",
        draw,
        (7.6, 3.6),
    )


def _instants(data: dict[str, Any]) -> Picture:
    def draw(figure: Any) -> None:
        axes = _grid(figure, 1)
        for column, example in enumerate(EXAMPLES):
            axis, granted = axes[0, column], data[f"{example}_granted"].astype(bool)
            nodes = granted.shape[1]
            for node in range(nodes):
                when = _TIME[granted[:, node]]
                axis.plot(when, np.full(len(when), node), "|", color=palette.SENSORS[node], ms=16)
            axis.set_yticks(range(nodes), [f"sensor {node + 1}" for node in range(nodes)])
            axis.set_ylim(-0.6, nodes - 0.4)
            axis.grid(False, axis="y")

    place = data["settings"].index(OURS)
    rates = [
        ", ".join(percent(float(r)) for r in data[f"{e}_rates"][place].mean(-1)) for e in EXAMPLES
    ]
    return Picture(
        "figure_7",
        "Figure 7: triggering instants",
        "One run; each mark is a transmission. Over all runs the sensors transmit at "
        f"{rates[0]} of the instants on the printed example, {rates[1]} on the carts.",
        draw,
        (7.6, 2.6),
    )
