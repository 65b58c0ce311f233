"""The truth departs from what filters, rules and memory assume: by how much, and who knows."""

import re
from typing import Any, ClassVar

import numpy as np
import pytest
from parts import Parts
from scipy import stats

from fusion_gym import linalg
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.task import CommonOptions, Scenario, Task
from fusion_gym.envs.registration import ENVIRONMENTS, make_task
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers.silence import silence_bound
from fusion_gym.validation import ConfigurationError

TOBIT = "fusion_gym/TobitOscillator-v1"
BIASED = "fusion_gym/BiasedOscillator-v2"
CORRELATED = "fusion_gym/CorrelatedTracking-v1"
JUMP = "fusion_gym/MarkovJumpTracking-v1"
LINEAR = "fusion_gym/LinearFusion-v2"
INPUT = "fusion_gym/UnknownInput-v1"
REMOTE = "fusion_gym/RemoteEstimation-v1"
RUNS = 40_000
AS_ASSUMED = {
    "true_process_noise": 1,
    "true_measurement_noise": 1.0,
    "true_threshold_shift": 0,
    "true_transition": 1.0,
}


def sensed(env_id: str, steps: int = 1, **options: Any) -> tuple[Any, list[Any]]:
    """The task, and the states of many runs at time 0 and after each of some silent steps."""
    task = make_task(env_id, **options)
    draw, system = np.random.default_rng(5), Parts.of(task)
    states = [system.start(draw.standard_normal((system.plant.start_channels, RUNS)))]
    silence = np.zeros((task.sensors, RUNS), dtype=np.bool_)
    for _ in range(steps):
        noise = draw.standard_normal((system.plant.noise_channels, RUNS))
        states.append(system.deliver(system.sense(states[-1], noise), silence))
    return task, states


def close_variance(values: Any, expected: float) -> bool:
    """Whether the variance of independent normal values is the expected one."""
    return bool(abs(np.var(values) / expected - 1.0) < 4.5 * np.sqrt(2.0 / np.size(values)))


class TestNothingChangesWithoutDeparture:
    @pytest.mark.parametrize("env_id", [name for name in ENVIRONMENTS if "fusion_gym/" in name])
    def test_bitwise(self, env_id: str) -> None:
        """Also where the options stand there, with the values of the model."""

        def course(**options: Any) -> bytes:
            batch = EpisodeBatch.seeded(make_task(env_id, **options), 3, 8)
            observed = []
            for _ in range(10):
                outcome = batch.step(np.ones((batch.task.sensors, 3), dtype=np.bool_))
                observed += [batch.observe().tobytes(), outcome.error.tobytes()]
            return b"".join(observed)

        assert course(**AS_ASSUMED) == course()
        task = make_task(env_id)
        if "nature" in vars(task.plant) and task.noise is None:
            assert course(true_process_noise=1.5) != course()

    def test_numbers_take_no_noise(self) -> None:
        plain = make_task(TOBIT).plant
        moved = make_task(TOBIT, true_process_noise=2.0, true_threshold_shift=0.5).plant
        drawn = make_task(TOBIT, true_process_noise=(0.5, 2.0), true_transition=(0.9, 1.1)).plant
        assert moved.start_channels == plain.start_channels
        assert drawn.start_channels == plain.start_channels + 2
        assert moved.noise_channels == drawn.noise_channels == plain.noise_channels


@pytest.mark.parametrize("env_id", [TOBIT, BIASED, CORRELATED, JUMP, INPUT, REMOTE])
@pytest.mark.parametrize(
    "option", ["true_process_noise", "true_measurement_noise", "true_transition"]
)
def test_truth_and_measurements_change_in_proportion(env_id: str, option: str) -> None:
    """From the same noise: as much by a factor of 1.1 as by one of 0.9 the other way."""
    if (env_id, option) == (REMOTE, "true_measurement_noise"):
        return
    limits = {"censoring_threshold": -np.inf, "censoring_upper": np.inf}
    options: dict[str, dict[str, Any]] = {BIASED: limits, REMOTE: {"initial_deviation": 1.0}}
    options[TOBIT] = {"censoring_threshold": -np.inf}
    values = []
    for factor in ({option: 0.9}, {}, {option: 1.1}):
        task, states = sensed(env_id, **options.get(env_id, {}), **factor)
        signals = Signals(dict(task.estimator.read(states[1].estimate)))
        values.append([signals["measurement"], signals["held"], *map(Parts.of(task).truth, states)])
    for low, plain, high in zip(*values, strict=True):
        np.testing.assert_allclose(high - plain, plain - low, atol=1e-9)
    changed = [(low != high).any() for low, _, high in zip(*values, strict=True)]
    assert changed[0]
    assert changed[-1] == (option != "true_measurement_noise")


class TestNoise:
    @pytest.mark.parametrize("factor", [0.5, 2.0])
    @pytest.mark.parametrize("env_id", [TOBIT, BIASED, LINEAR])
    def test_the_free_first_measurement_has_the_true_noise(
        self, env_id: str, factor: float
    ) -> None:
        upper = {} if env_id == TOBIT else {"censoring_upper": np.inf}
        free = {"censoring_threshold": -np.inf, **upper}
        task, states = sensed(env_id, steps=0, true_measurement_noise=factor, **free)
        sensors = task.estimator.centre.sensors
        latent = linalg.matvec(sensors.measurement_matrix, states[0].plant.truth)
        noise = (states[0].plant.measurement - latent) / sensors.deviation
        assert close_variance(noise, factor**2)

    def test_shared_noise_multiplies_the_scale(self) -> None:
        """In correlated tracking the sensors' noise has a part of the plant's, which grows too."""
        _, states = sensed(
            CORRELATED, noise_scale=0.5, true_process_noise=3.0, true_measurement_noise=2.0
        )
        shaken = states[1].plant.measurement[:, 0] - states[1].plant.truth
        for sensor, (variance, coupling) in enumerate(
            zip((0.64, 0.36, 0.49), (0.2, 0.4, 0.1), strict=True)
        ):
            expected = 0.5 * (4.0 * variance + 9.0 * coupling**2 * 0.16)
            assert close_variance(shaken[sensor], expected)


class TestThresholds:
    @pytest.mark.parametrize("shift", [-0.4, 0.7])
    def test_share_of_what_is_censored(self, shift: float) -> None:
        """The second state starts as N(0, 0.1) and is measured with noise of variance 0.5."""
        _, states = sensed(TOBIT, steps=0, true_threshold_shift=shift)
        measured = states[0].plant.measurement[:, 1]
        share = stats.norm.cdf(shift / np.sqrt(0.6))
        result = (measured == shift).mean(-1)
        assert np.abs(result - share).max() < 4.5 * np.sqrt(share * (1.0 - share) / RUNS)
        assert measured.min() == shift

    def test_both_limits_move(self) -> None:
        _, states = sensed(BIASED, steps=3, true_threshold_shift=0.25, true_process_noise=20.0)
        measured = np.stack([state.plant.measurement for state in states])
        assert (measured.min(), measured.max()) == (-4.75, 5.25)

    def test_filters_and_signals_know_the_old_ones(self) -> None:
        task = make_task(TOBIT, filter="tobit", true_threshold_shift=0.5)
        batch = EpisodeBatch.seeded(task, 50, 0)
        signals = batch.signals()
        assert (signals["measurement"] == 0.5).any()
        assert not signals["censored"].any()


class TestMotion:
    def test_both_motions(self) -> None:
        """x + c (Φ x - x) plus Γ w, with the matrices of the mode that holds."""
        _, states = sensed(JUMP, true_transition=0.5, true_process_noise=2.0)
        phi = np.array([[[0.8, 0.1], [0.0, 0.6]], [[1.0, 0.5], [0.0, 0.5]]])
        gamma = np.array([[1.5, 0.6], [0.125, 0.5]])
        before, after = states
        for mode in (0, 1):
            runs = before.plant.mode == mode
            moved = 0.5 * (np.eye(2) + phi[mode]) @ before.plant.truth[:, runs]
            moved += gamma[mode][:, None] * before.plant.process_noise[0, runs]
            np.testing.assert_allclose(after.plant.truth[:, runs], moved, atol=1e-12)

    def test_between_two_instants(self) -> None:
        """The force acts as it did."""
        task, states = sensed(INPUT, process_covariance=np.zeros((4, 4)), true_transition=1.2)
        dynamics = task.plant.dynamics
        before, after = (task.plant.truth(state.plant) for state in states)
        matrix = np.eye(4) + 1.2 * (dynamics.transition[..., 0] - np.eye(4))
        force = dynamics.input_matrix[..., 0] @ after[4:]
        expected = matrix @ before[:4] + force
        np.testing.assert_allclose(after[:4], expected, atol=1e-12)

    def test_of_a_source(self) -> None:
        """A random walk is one no more: its coefficient itself is multiplied."""
        _, states = sensed(REMOTE, steps=30, coefficient=1.0, true_transition=0.8)
        stationary = (1.0 - 0.8**60) / (1.0 - 0.8**2)
        assert close_variance(states[-1].plant.truth, stationary)


class TestDraws:
    OPTIONS: ClassVar[dict[str, Any]] = {
        "true_process_noise": (0.5, 2.0),
        "true_threshold_shift": (-0.3, 0.6),
        "true_transition": (0.9, 1.1),
    }

    def test_laws(self) -> None:
        _, states = sensed(TOBIT, steps=0, **self.OPTIONS)
        process, measurement, shift, transition = states[0].plant.departure
        assert (measurement == 1.0).all()
        laws = (
            (process, stats.loguniform(0.5, 2.0)),
            (shift, stats.uniform(-0.3, 0.9)),
            (transition, stats.loguniform(0.9, 1.1)),
        )
        for values, law in laws:
            assert stats.kstest(values, law.cdf).pvalue > 1e-3
        assert abs(np.corrcoef(process, transition)[0, 1]) < 0.03

    def test_an_episode_has_one_whatever_is_requested(self) -> None:
        task = make_task(TOBIT, **self.OPTIONS)
        left_value, other = (EpisodeBatch.seeded(task, 4, 3) for _ in range(2))
        first = left_value.state.plant.departure.copy()
        for _ in range(5):
            left_value.step(np.ones((3, 4), dtype=np.bool_))
            other.step(np.zeros((3, 4), dtype=np.bool_))
        np.testing.assert_array_equal(left_value.state.plant.departure, first)
        np.testing.assert_array_equal(other.state.plant.departure, first)
        np.testing.assert_array_equal(left_value.state.plant.truth, other.state.plant.truth)
        left_value.reset(np.array([1]))
        assert (left_value.state.plant.departure[0] != first[0]).tolist() == [
            False,
            True,
            False,
            False,
        ]


class TestWhoKnows:
    @pytest.mark.parametrize("env_id", [TOBIT, BIASED, CORRELATED, JUMP, INPUT, REMOTE])
    def test_nobody_who_plans(self, env_id: str) -> None:
        """What a policy sees of a state, and simulates from it, moves as the model says."""
        departed = make_task(env_id, true_process_noise=2.0, true_transition=0.9)
        batch = EpisodeBatch.seeded(departed, 4, 0)
        assert batch.state.plant.departure is not None
        observed = batch.signals()["estimate"]
        assert not {"departure", "truth"} & set(dir(observed))
        plants, draw = (departed.plant, make_task(env_id).plant), np.random.default_rng(1)
        size, channels = len(plants[1].state_names), plants[1].draw_channels
        assert channels is not None
        noise, time = draw.standard_normal((channels, 4)), np.ones(4)
        believed = np.ones((size, 4)), np.repeat(np.eye(size)[..., None], 4, axis=-1)
        moving = draw.standard_normal((plants[1].noise_channels, 4))
        drawn = [plant.draw(observed.measurement, *believed, noise, time) for plant in plants]
        after = [plant.sense(state, moving) for plant, state in zip(plants, drawn, strict=True)]
        np.testing.assert_array_equal(*(plants[1].truth(state) for state in after))

    def test_a_memory_state_lives_in_the_same_world(self) -> None:
        task = make_task(
            JUMP, filter="centralised", memory=True, memory_filter="imm", true_process_noise=2.0,
            true_transition=(0.8, 0.9), true_measurement_noise=3.0,
        )  # fmt: skip
        batch = EpisodeBatch.seeded(task, 4, 0)
        for _ in range(5):
            batch.step(np.zeros((3, 4), dtype=np.bool_))
            every = batch.memory.states["every"]
            sampled = task.plant.sensors.sampled(batch.state.plant.time)
            measured = (every.measurement, batch.state.estimate.measurement)
            np.testing.assert_array_equal(*(each[:, 0][sampled] for each in measured))

    def test_a_rule_is_made_from_the_model(self) -> None:
        """The Whittle index and a searched schedule are those of the model."""
        other = {"true_process_noise": 3.0, "true_transition": 0.9}
        for env_id, text in ((REMOTE, "whittle:price=2"), (JUMP, "periodic_optimum:packets=1")):
            tasks = [make_task(env_id, **options) for options in ({}, other)]
            batch = EpisodeBatch.seeded(tasks[1], 5, 0)
            expected = []
            for task in tasks:
                policy = make_policy(text, task)
                policy.reset(5, 0)
                expected.append(policy(batch.signals()))
            np.testing.assert_array_equal(*expected)

    def test_a_proven_bound_is_refused(self) -> None:
        task = make_task(TOBIT, filter="kalman", censoring_threshold=-np.inf, true_transition=1.1)
        with pytest.raises(ConfigurationError, match=r"^true_transition = 1.1 is not .* bound"):
            silence_bound(task, [0.1])


@pytest.mark.parametrize(
    ("env_id", "options", "text"),
    [
        (TOBIT, {"true_process_noise": 0.0}, "from 0.001 to 1000"),
        (TOBIT, {"true_measurement_noise": (2.0, 0.5)}, "low < high"),
        (TOBIT, {"true_transition": 50.0}, "spectral radius"),
        (JUMP, {"true_transition": (1.0, 9.0)}, "spectral radius"),
        (REMOTE, {"true_measurement_noise": 2.0}, "it must be 1 here, .* without noise"),
        (REMOTE, {"true_threshold_shift": 0.1}, "it must be 0 here, .* no sensor is censored"),
        (REMOTE, {"coefficient": 0.0, "true_transition": 0.9}, "it must be 1 here"),
        (INPUT, {"true_threshold_shift": (-0.1, 0.1)}, "it must be 0 here"),
        (CORRELATED, {"track_actual": True, "true_transition": 0.9}, "with track_actual=True"),
        (
            TOBIT,
            {"filter": "kalman", "censoring_threshold": -np.inf, "true_threshold_shift": 0.1},
            "it must be 0 here",
        ),
        (TOBIT, {"transition": np.eye(2), "true_transition": 0.9}, "it must be 1 here"),
        (
            INPUT,
            {"process_covariance": np.zeros((4, 4)), "true_process_noise": 2.0},
            "it must be 1 here, .* no process noise",
        ),
    ],
)
def test_what_is_not_allowed(env_id: str, options: dict[str, Any], text: str) -> None:
    """One line that names the option, its value and what is allowed."""
    option = next(name for name in reversed(options) if name.startswith("true_"))
    with pytest.raises(
        ConfigurationError, match=rf"^{option} = .* is not allowed.*{text}"
    ) as result:
        make_task(env_id, **options)
    assert "\n" not in str(result.value)
    assert re.search(r"must|may", str(result.value))


def test_a_system_that_knows_no_departure_refuses_it() -> None:
    """A system of one's own takes the common options, and none is ignored."""
    task = make_task(REMOTE)
    options = CommonOptions(true_process_noise=2.0, token_cost=1.0)
    scenario = Scenario(options, task.plant, task.estimator, np.ones(1))
    with pytest.raises(ConfigurationError, match=r"true_process_noise = 2 is not allowed here: "):
        Task.create(scenario)
