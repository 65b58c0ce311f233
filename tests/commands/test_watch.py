"""Policies side by side on the same noise: the pictures, the command and its films."""

import os
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
from refusals import refused

import fusion_gym
from fusion_gym.commands import watch as command
from fusion_gym.commands.watch import save_film
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.drawing import Film
from fusion_gym.evaluation.episodes import watch
from fusion_gym.policies.registry import make_policy

TOBIT = "fusion_gym/TobitOscillator-v1"


def frames(*names: str, seed: int = 3, steps: int | None = None, **options: Any) -> list[Any]:
    task = fusion_gym.make_task(TOBIT, **({"horizon": 4} | options))
    return list(watch(task, {name: make_policy(name, task) for name in names}, seed, steps))


def test_pictures_stand_side_by_side_one_a_step() -> None:
    single, both = frames("always"), frames("always", "never")
    assert len(single) == len(both) == 4
    height, width, _ = single[0].shape
    assert all(frame.shape == (height, 2 * width, 3) for frame in both)
    assert [len(frames("always", steps=steps)) for steps in (1, 2)] == [1, 2]


def test_a_policy_alone_is_what_the_environment_draws() -> None:
    """The same noise and the same pictures, but for the words above them and the axes."""
    env: Any = gym.make(TOBIT, horizon=4, render_mode="rgb_array")
    env.reset(seed=3)
    for _ in range(4):
        env.step(np.ones(3, dtype=np.int8))
    drawn, watched = env.render(), frames("always")[-1]
    assert drawn.shape == watched.shape
    np.testing.assert_array_equal(drawn[-180:], watched[-180:])  # requests and tokens


def test_the_axes_of_a_film_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """They hold all that any picture shows, and the frames differ by what is drawn alone."""
    limits: list[Any] = []
    draw = Film.frame
    monkeypatch.setattr(
        Film, "frame", lambda *a, **words: (limits.append(words["limits"]), draw(*a, **words))[1]
    )
    frames("always", "never", horizon=12)
    assert all(own == limits[0] for own in limits)
    alone = fusion_gym.make_task(TOBIT, horizon=12)
    film = Film(alone, 1)
    batch = EpisodeBatch.seeded(alone, 1, 3)
    for _ in range(12):
        film.record(batch, batch.step(np.zeros((3, 1), np.bool_)))
        for (low, high), (least, most) in zip(film.limits(), limits[0], strict=True):
            assert least <= low <= high <= most


def test_a_film_has_axes_for_its_steps_and_panels_for_what_changes() -> None:
    """No axis beyond the last step, and no panel of unlimited tokens."""
    task = fusion_gym.make_task(TOBIT)
    for film, right in ((Film(task, 1, 40), 41), (Film(task, 1), 61)):
        height = film.frame().shape[0]
        axis = film._axes[-1]
        assert axis.get_xlim() == (0, right)
        assert axis.get_ylabel() == "tokens"
    unlimited = Film(fusion_gym.make_task(TOBIT, tokens="unlimited"), 1)
    assert height - unlimited.frame().shape[0] == 70
    assert unlimited._axes[-1].get_ylabel() == "sensor"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "granted denied"),
        ({"channel": "independent", "drop_probability": 0.5}, "arrived denied lost"),
        ({"delay": 2}, "arrived denied late"),
        ({"delay": (0, 3), "channel": "gilbert_elliott"}, "arrived denied lost late"),
        ({"access": "collision"}, "arrived denied lost"),
    ],
)
def test_marks_are_what_the_network_does(options: dict[str, Any], words: str) -> None:
    """In every picture: requests that are denied, lost or late, and arrivals until then."""
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", horizon=12, token_rate=1.5, **options)
    batch, film, drawn = EpisodeBatch.seeded(task, 2, 3), Film(task, 2), np.random.default_rng(1)
    expected: dict[str, set[tuple[int, int]]] = {word: set() for word in words.split()}
    ends, arrived = {}, set()
    for step in range(1, 13):
        draws, request = batch.state.network.draws, drawn.random((2, 2)) < 0.7
        outcome = batch.step(request)
        film.record(batch, outcome)
        for sensor in np.flatnonzero(request[:, 1]).tolist():
            delay = options.get("delay", 0) if draws.delay is None else draws.delay[sensor, 1]
            lost = draws.lost is not None and draws.lost[sensor, 1]
            lost |= options.get("access") == "collision" and outcome.granted[:, 1].all()
            word = "lost" if lost else "late" if delay else words.split()[0]
            word = word if outcome.granted[sensor, 1] else "denied"
            expected[word].add((step, sensor))
            if word == "late":
                ends[step, sensor] = step + delay
        arrived |= {(step, sensor) for sensor in np.flatnonzero(outcome.arrived[:, 1]).tolist()}
        film.frame(1)
        lines = {line.get_label(): line.get_xydata() for line in film._axes[2].get_lines()}
        assert lines.keys() == expected.keys()
        late = lines.get("late", np.zeros((0, 2))).reshape(-1, 3, 2)
        lines |= {"late": late[:, 0]} if "late" in lines else {}
        assert {word: {*map(tuple, own.tolist())} for word, own in lines.items()} == expected
        assert np.isnan(late[:, 2]).all()  # no line from an arrival to the next packet
        for (sent, sensor), (end, row) in late[:, :2].tolist():
            assert row == sensor - 0.3
            assert end == ends[sent, sensor] if ends[sent, sensor] <= step else np.isnan(end)
    assert all(expected[word] for word in words.split()[1:])
    early = expected.get("arrived", expected.get("granted", set()))
    assert arrived == early | {(end - 1, own) for (_, own), end in ends.items() if end <= 13}
    assert film._figure.legends[0].get_texts()[0].get_text() == words.split()[0]


def test_both_policies_meet_the_same_noise() -> None:
    """The same rule under two names: both halves alike, below the names."""
    task = fusion_gym.make_task(TOBIT, horizon=4)
    rules = {name: make_policy("innovation_threshold:threshold=1", task) for name in ("a", "b")}
    for frame in watch(task, rules, seed=5):
        left, right = np.hsplit(frame, 2)
        np.testing.assert_array_equal(left[45:], right[45:])


def test_what_cannot_be_watched_is_refused_at_once() -> None:
    task = fusion_gym.make_task(TOBIT, horizon=4)
    rule = {"always": make_policy("always", task)}
    refused(lambda: watch(task, rule, steps=5), "steps = 5")
    refused(lambda: watch(task, rule, seed=-1), "seed = -1")
    refused(lambda: watch(task, {}), "policies")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["film.gif", "film.mp4"])
def test_the_command_writes_films(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = f"--env {TOBIT} --policy always --against never --set horizon=6 --save {name} --fps 5"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["watch", *words.split()])
    command.Watch.main()
    with imageio.get_reader(name) as reader:
        film: Any = reader
        visible = [np.asarray(frame)[..., :3] for frame in film]
    assert len(visible) == 6
    task = fusion_gym.make_task(TOBIT, horizon=6)
    rules = {name: make_policy(name, task) for name in ("always", "never")}
    for observed, drawn in zip(visible, watch(task, rules), strict=True):
        assert observed.shape == drawn.shape
        # 64 colours of a GIF, chroma of a video.
        assert np.abs(observed.astype(int) - drawn).mean() < 3.0
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_device_takes_a_gif() -> None:
    save_film([np.zeros((8, 8, 3), np.uint8)] * 2, Path(os.devnull), 10)
    assert Path(os.devnull).is_char_device()


def test_a_film_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def broken() -> Any:
        yield np.zeros((16, 16, 3), dtype=np.uint8)
        raise KeyboardInterrupt

    for name in ("film.gif", "film.mp4"):
        with pytest.raises(KeyboardInterrupt):
            save_film(broken(), tmp_path / name, 10)
    assert not list(tmp_path.iterdir())
