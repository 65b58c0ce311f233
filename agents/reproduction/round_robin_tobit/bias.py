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
from ..shown import Claim, Picture, Shown, Table
from . import figures
from .judging import always_below, explained, listed
from .runs import (
    FREE,
    OSCILLATOR,
    TRACKING,
    armse,
    armse_number,
    compared,
    curve,
    floor,
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
    found = _curves(OSCILLATOR, episodes, seed)
    for name, options in _BOTH.items():
        task = fusion_gym.make_task(OSCILLATOR, **options)
        run = record_episode(task, round_robin(task), seed)
        found |= {"truth": run.truth, f"{name}_mean": run.mean}
    return found | {"held_whole": _held(seed, FREE), "held_clipped": _held(seed, {})}


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
        **{f"{name}_rmse": curve(found) for name, found in errors.items()},
        **{f"{name}_armse": armse(found) for name, found in errors.items()},
        "difference": compared(errors["aware"], errors["unaware"]),
        "silent": armse(never)["mean"],
        "floor": floor(env),
        "bias_deviation": float(
            np.sqrt(np.asarray(silent.settings["bias_noise_covariance"])[0, 0])
        ),
    }


def _held(seed: int, options: dict[str, Any]) -> Array:
    """What the estimators hold (H, sensors) in the first run, by equation (4)."""
    task = fusion_gym.make_task(OSCILLATOR, **options)
    found = np.empty((task.horizon, task.sensors))

    def look(batch: EpisodeBatch, outcome: Outcome, step: int, runs: slice) -> None:
        found[step] = batch.delivered.held[:, 0, 0]

    walk(task, round_robin(task), 1, seed, look)
    return found


def show_oscillator(kept: dict[str, Any]) -> Shown:
    """Figures 2 to 6."""
    share = float(
        np.mean((kept["held_clipped"] <= LIMITS[0]) | (kept["held_clipped"] >= LIMITS[1]))
    )
    truth, aware, unaware = kept["truth"], kept["aware_mean"], kept["unaware_mean"]
    pictures = [
        Picture(
            "figure_2", "Figure 2: measurements before and after censoring",
            f"What the two estimators hold over a run: every second step a new value (4), clipped "
            f"at ±5 (dashed) by (6). In this run {percent(share)} of what is held is clipped. The "
            "sensors only say there on which side the state lies.",
            partial(
                figures.measurements, whole=kept["held_whole"], clipped=kept["held_clipped"],
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
            f"standard deviation {kept['bias_deviation']:.2g}, has not shown itself in any "
            "measurement yet, and earlier ones only through x.",
            partial(
                figures.curves,
                panels=[("bias b", [figures.aware(aware[:, 2]), figures.true(truth[:, 2])])],
            ),
            (7.2, 3.4),
        ),
        _states(kept, "figure_5", "Figure 5: RMSE1 and RMSE2, bias ignored and not",
                ("RMSE1 (of x1)", "RMSE2 (of x2)"), figures.STEP,
                "Root mean squared errors over all runs with their 95 % bands. Knowing of the bias "
                "is worth a factor of about "
                f"{kept['unaware_armse']['mean'][0] / kept['aware_armse']['mean'][0]:.2g}. The "
                "paper's filter has heavy tails: single runs make the jags."),
        _bias(kept, "figure_6", "Figure 6: RMSE3 of the filter that knows of the bias",
              "RMSE3 (of b)", figures.STEP),
    ]  # fmt: skip
    tracks = explained(kept["aware_armse"]["mean"], kept["silent"])
    misses = explained(kept["unaware_armse"]["mean"], kept["silent"])
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
        _lower(kept, "RMSE1 and RMSE2 of FTKF-DB always lie below those of FTKF",
               "Section IV.A, Fig. 5"),
        _satisfactory(kept, "RMSE3 of FTKF-DB is within a satisfactory range",
                      "Section IV.A, Fig. 6"),
    ]  # fmt: skip
    return Shown(pictures, [_numbers(kept, "oscillator", ("x1", "x2", "b"), ("", "", ""))], claims)


def show_target(kept: dict[str, Any]) -> Shown:
    """Figures 10 and 11."""
    factor = kept["unaware_armse"]["mean"][1] / kept["aware_armse"]["mean"][1]
    pictures = [
        _states(kept, "figure_10", "Figure 10: RMSE of position and velocity, bias ignored and not",
                ("position RMSE (m)", "velocity RMSE (m/s)"), figures.TARGET_STEP,
                "The filter that ignores the acceleration falls behind for ever, in the velocity "
                f"by a factor of {factor:.2g} over the run; the other settles within a few "
                "steps. Nothing is censored here, so its curves are those "
                "of a Kalman filter."),
        _bias(kept, "figure_11", "Figure 11: RMSE of the bias",
              "acceleration RMSE (m/s²)", figures.TARGET_STEP),
    ]  # fmt: skip
    close = [
        one / least for one, least in zip(kept["aware_armse"]["mean"], kept["floor"], strict=True)
    ]
    claims = [
        _lower(kept, "RMSE of position and velocity of FTKF-DB always lie below those of FTKF",
               "Section IV.B, Fig. 10"),
        _satisfactory(kept, "The bias's RMSE is within a satisfactory range",
                      "Section IV.B, Fig. 11"),
        Claim(
            "The fused estimate is the global optimum (nothing censored)",
            "Theorem 2, Section IV.B",
            verdict(abs(one - 1.0) < 0.03 for one in close),
            f"ARMSE over the Riccati equation's, for this order of transmissions: {listed(close)}",
        ),
    ]  # fmt: skip
    names, units = ("position", "velocity", "acceleration"), ("m", "m/s", "m/s²")
    return Shown(pictures, [_numbers(kept, "target", names, units)], claims)


def _states(
    kept: dict[str, Any], name: str, title: str, labels: tuple[str, str], step: str, caption: str
) -> Picture:
    panels = [
        (
            label,
            [
                figures.unaware(kept["unaware_rmse"][..., i]),
                figures.aware(kept["aware_rmse"][..., i]),
            ],
        )
        for i, label in enumerate(labels)
    ]
    draw = partial(figures.curves, panels=panels, step=step, from_zero=True)
    return Picture(name, title, caption, draw, (7.2, 4.8))


def _bias(kept: dict[str, Any], name: str, title: str, label: str, step: str) -> Picture:
    found = kept["aware_rmse"][..., 2]
    bound = np.full(found.shape[1], kept["bias_deviation"])
    lines = [figures.aware(found), figures.least(bound, "√Ξ: no filter lies below")]
    caption = (
        f"The mean over time is {kept['aware_armse']['mean'][2]:.3g}; the dotted line is √Ξ = "
        f"{kept['bias_deviation']:.3g}, which the last step of the bias alone is worth, and the "
        f"least mean that any filter has is {kept['floor'][2]:.3g}."
    )
    draw = partial(figures.curves, panels=[(label, lines)], step=step, from_zero=True)
    return Picture(name, title, caption, draw, (7.2, 3.4))


def _worst(mean: Array, truth: Array) -> str:
    return f"{np.abs(mean - truth)[:, :2].max():.2g}"


def _shares(values: list[float]) -> str:
    return ", ".join(percent(max(value, 0.0)) for value in values)


def _lower(kept: dict[str, Any], text: str, source: str) -> Claim:
    found, words = always_below(kept["difference"][..., :2])
    return Claim(text, source, found, f"of 2 states at every step it is {words}")


def _satisfactory(kept: dict[str, Any], text: str, source: str) -> Claim:
    ratio = kept["aware_armse"]["mean"][2] / kept["floor"][2]
    far = kept["aware_armse"]["mean"][2] / kept["silent"][2]
    return Claim(
        text, source, verdict([ratio < _SATISFACTORY]),
        f"its mean over time is {ratio:.3g} times the least that any filter can have "
        f"(satisfactory: below {_SATISFACTORY}), and {far:.2g} times that without measurements",
    )  # fmt: skip


def _numbers(
    kept: dict[str, Any], name: str, states: tuple[str, ...], units: tuple[str, ...]
) -> Table:
    filters = {"aware": "FTKF-DB", "unaware": "FTKF (bias ignored)"}
    rows = [
        armse_number(f"ARMSE of {state}, {label}", kept[f"{key}_armse"], i, None, units[i])
        for key, label in filters.items()
        for i, state in enumerate(states)
        if key == "aware" or i < 2
    ]
    note = (
        "The paper shows curves here and prints no numbers. The least that any filter can have: "
        f"{listed(kept['floor'])}; without measurements: {listed(kept['silent'])}."
    )
    return Table(name, "Mean over time of the curves", rows, note)
