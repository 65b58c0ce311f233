"""Figures 2 to 6, 10 and 11 of round_robin_tobit: the bias in the filter, or ignored by it."""

from functools import partial
from typing import Any

import numpy as np

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.runs import Outcome
from fusion_gym.evaluation.episodes import record_episode

from ..judging import percent, verdict
from ..piece_result import Claim, NumbersTable, Picture, PieceResult
from . import figures
from .judging import always_below, explained, list_numbers
from .runs import (
    FREE,
    OSCILLATOR,
    TRACKING,
    armse,
    armse_number,
    error_curve,
    floor,
    paired_increase,
    round_robin,
    squares,
    walk,
)

LIMITS = (-5.0, 5.0)
_PRECISE = 0.9  # share of the open-loop variance that an estimate which tracks precisely explains
_SATISFACTORY = 1.5  # times the least that any filter can have
_BOTH = {"aware": {}, "unaware": {"bias_aware": False}}


def compute_oscillator(episodes: int, seed: int) -> dict[str, Any]:
    """One run, and the RMSE of both filters."""
    result = _curves(OSCILLATOR, episodes, seed)
    for name, options in _BOTH.items():
        task = fusion_gym.make_task(OSCILLATOR, **options)
        run = record_episode(task, round_robin(task), seed)
        result |= {"truth": run.truth, f"{name}_mean": run.mean}
    return result | {"held_whole": _held(seed, FREE), "held_clipped": _held(seed, {})}


def compute_target(episodes: int, seed: int) -> dict[str, Any]:
    """The RMSE of both filters."""
    return _curves(TRACKING, episodes, seed)


def _curves(env: str, episodes: int, seed: int) -> dict[str, Any]:
    errors = {}
    for name, options in _BOTH.items():
        task = fusion_gym.make_task(env, **options)
        errors[name] = squares(task, round_robin(task), episodes, seed)
    silent = fusion_gym.make_task(env)
    never = squares(silent, fusion_gym.make_policy("never", silent), episodes, seed)
    return {
        **{f"{name}_rmse": error_curve(error) for name, error in errors.items()},
        **{f"{name}_armse": armse(error) for name, error in errors.items()},
        "difference": paired_increase(errors["aware"], errors["unaware"]),
        "silent": armse(never)["mean"],
        "floor": floor(env),
        "bias_deviation": float(
            np.sqrt(np.asarray(silent.settings["bias_noise_covariance"])[0, 0])
        ),
    }


def _held(seed: int, options: dict[str, Any]) -> Array:
    """What the estimators hold (H, sensors) in the first run, by equation (4)."""
    task = fusion_gym.make_task(OSCILLATOR, **options)
    values = np.empty((task.horizon, task.sensors))

    def look(batch: EpisodeBatch, outcome: Outcome, step: int, runs: slice) -> None:
        values[step] = batch.delivered.held[:, 0, 0]

    walk(task, round_robin(task), 1, seed, look)
    return values


def show_oscillator(data: dict[str, Any]) -> PieceResult:
    """Figures 2 to 6."""
    share = float(
        np.mean((data["held_clipped"] <= LIMITS[0]) | (data["held_clipped"] >= LIMITS[1]))
    )
    truth, aware, unaware = data["truth"], data["aware_mean"], data["unaware_mean"]
    pictures = [
        Picture(
            "figure_2", "Figure 2: measurements before and after censoring",
            f"What the two estimators hold over a run: every second step a new value (4), clipped "
            f"at ±5 (dashed) by (6). In this run {percent(share)} of what is held is clipped. The "
            "sensors only say there on which side the state lies.",
            partial(
                figures.biased_measurements, whole=data["held_whole"], clipped=data["held_clipped"],
                limits=LIMITS,
            ),
            (7.2, 4.6),
        ),
        Picture(
            "figure_3", "Figure 3: states and their estimates",
            f"The same run. The filter that knows of the bias is off by {_worst(aware, truth)} at "
            f"most, the one that ignores it by {_worst(unaware, truth)}: it takes the drift for "
            "noise.",
            partial(
                figures.curves,
                panels=[
                    (
                        f"x{i + 1}",
                        [
                            figures.unaware(unaware[:, i]), figures.aware(aware[:, i]),
                            figures.true(truth[:, i]),
                        ],
                    )
                    for i in range(2)
                ],
            ),
            (7.2, 4.8),
        ),
        Picture(
            "figure_4", "Figure 4: the bias and its estimate",
            "The same run. The estimate follows the bias some steps late: its last step, of "
            f"standard deviation {data['bias_deviation']:.2g}, has not shown itself in any "
            "measurement yet, and earlier ones only through x.",
            partial(
                figures.curves,
                panels=[("bias b", [figures.aware(aware[:, 2]), figures.true(truth[:, 2])])],
            ),
            (7.2, 3.4),
        ),
        _states(data, "figure_5", "Figure 5: RMSE1 and RMSE2, bias ignored and not",
                ("RMSE1 (of x1)", "RMSE2 (of x2)"), figures.STEP,
                "Root mean squared errors over all runs with their 95 % bands. Knowing of the bias "
                "is worth a factor of about "
                f"{data['unaware_armse']['mean'][0] / data['aware_armse']['mean'][0]:.2g}. The "
                "paper's filter has heavy tails: single runs make the jags."),
        _bias(data, "figure_6", "Figure 6: RMSE3 of the filter that knows of the bias",
              "RMSE3 (of b)", figures.STEP),
    ]  # fmt: skip
    tracks = explained(data["aware_armse"]["mean"], data["silent"])
    misses = explained(data["unaware_armse"]["mean"], data["silent"])
    claims = [
        Claim(
            "FTKF-DB tracks states and bias precisely",
            "Section IV.A, Figs. 3 and 4",
            verdict(share >= _PRECISE for share in tracks),
            f"it explains {_shares(tracks)} of the open-loop variance of x1, x2, b (precise: "
            f"{percent(_PRECISE)} or more)",
        ),
        Claim(
            "FTKF deviates considerably and cannot track the bias",
            "Section IV.A, Figs. 3 and 4",
            verdict([max(misses[:2]) < _PRECISE, misses[2] < 0.05]),
            f"it explains {_shares(misses)} of the open-loop variance of x1, x2, b",
        ),
        _lower(data, "RMSE1 and RMSE2 of FTKF-DB always lie below those of FTKF",
               "Section IV.A, Fig. 5"),
        _satisfactory(data, "RMSE3 of FTKF-DB is within a satisfactory range",
                      "Section IV.A, Fig. 6"),
    ]  # fmt: skip
    return PieceResult(
        pictures, [_numbers(data, "oscillator", ("x1", "x2", "b"), ("", "", ""))], claims
    )


def show_target(data: dict[str, Any]) -> PieceResult:
    """Figures 10 and 11."""
    factor = data["unaware_armse"]["mean"][1] / data["aware_armse"]["mean"][1]
    pictures = [
        _states(data, "figure_10", "Figure 10: RMSE of position and velocity, bias ignored and not",
                ("position RMSE (m)", "velocity RMSE (m/s)"), figures.TARGET_STEP,
                "The filter that ignores the acceleration falls behind for ever, in the velocity "
                f"by a factor of {factor:.2g} over the run; the other settles within a few "
                "steps. Nothing is censored here, so its curves are those "
                "of a Kalman filter."),
        _bias(data, "figure_11", "Figure 11: RMSE of the bias",
              "acceleration RMSE (m/s²)", figures.TARGET_STEP),
    ]  # fmt: skip
    close = [
        item / least for item, least in zip(data["aware_armse"]["mean"], data["floor"], strict=True)
    ]
    claims = [
        _lower(data, "RMSE of position and velocity of FTKF-DB always lie below those of FTKF",
               "Section IV.B, Fig. 10"),
        _satisfactory(data, "The bias's RMSE is within a satisfactory range",
                      "Section IV.B, Fig. 11"),
        Claim(
            "The fused estimate is the global optimum (nothing censored)",
            "Theorem 2, Section IV.B",
            verdict(abs(item - 1.0) < 0.03 for item in close),
            "ARMSE over the Riccati equation's, for this order of transmissions: "
            f"{list_numbers(close)}",
        ),
    ]  # fmt: skip
    names, units = ("position", "velocity", "acceleration"), ("m", "m/s", "m/s²")
    return PieceResult(pictures, [_numbers(data, "target", names, units)], claims)


def _states(
    data: dict[str, Any], name: str, title: str, labels: tuple[str, str], step: str, caption: str
) -> Picture:
    panels = [
        (
            label,
            [
                figures.unaware(data["unaware_rmse"][..., i]),
                figures.aware(data["aware_rmse"][..., i]),
            ],
        )
        for i, label in enumerate(labels)
    ]
    draw = partial(figures.curves, panels=panels, step=step, from_zero=True)
    return Picture(name, title, caption, draw, (7.2, 4.8))


def _bias(data: dict[str, Any], name: str, title: str, label: str, step: str) -> Picture:
    result = data["aware_rmse"][..., 2]
    bound = np.full(result.shape[1], data["bias_deviation"])
    lines = [figures.aware(result), figures.least(bound, "√Ξ: no filter lies below")]
    caption = (
        f"The mean over time is {data['aware_armse']['mean'][2]:.3g}; the dotted line is √Ξ = "
        f"{data['bias_deviation']:.3g}, which the last step of the bias alone is worth, and the "
        f"least mean that any filter has is {data['floor'][2]:.3g}."
    )
    draw = partial(figures.curves, panels=[(label, lines)], step=step, from_zero=True)
    return Picture(name, title, caption, draw, (7.2, 3.4))


def _worst(mean: Array, truth: Array) -> str:
    return f"{np.abs(mean - truth)[:, :2].max():.2g}"


def _shares(values: list[float]) -> str:
    return ", ".join(percent(max(value, 0.0)) for value in values)


def _lower(data: dict[str, Any], text: str, source: str) -> Claim:
    result, words = always_below(data["difference"][..., :2])
    return Claim(text, source, result, f"of 2 states at every step it is {words}")


def _satisfactory(data: dict[str, Any], text: str, source: str) -> Claim:
    ratio = data["aware_armse"]["mean"][2] / data["floor"][2]
    far = data["aware_armse"]["mean"][2] / data["silent"][2]
    return Claim(
        text, source, verdict([ratio < _SATISFACTORY]),
        f"its mean over time is {ratio:.3g} times the least that any filter can have "
        f"(satisfactory: below {_SATISFACTORY}), and {far:.2g} times that without measurements",
    )  # fmt: skip


def _numbers(
    data: dict[str, Any], name: str, states: tuple[str, ...], units: tuple[str, ...]
) -> NumbersTable:
    filters = {"aware": "FTKF-DB", "unaware": "FTKF (bias ignored)"}
    rows = [
        armse_number(f"ARMSE of {state}, {label}", data[f"{key}_armse"], i, None, units[i])
        for key, label in filters.items()
        for i, state in enumerate(states)
        if key == "aware" or i < 2
    ]
    note = (
        "The paper shows curves here and prints no numbers. The least that any filter can have: "
        f"{list_numbers(data['floor'])}; without measurements: {list_numbers(data['silent'])}."
    )
    return NumbersTable(name, "Mean over time of the curves", rows, note)
