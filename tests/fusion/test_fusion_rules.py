"""Every rule of the table behind one interface, and the table's refusals."""

from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_gym import ConfigurationError
from fusion_gym.fusion.intersection import SequentialIntersection
from fusion_gym.fusion.table import REASONS, RULES, Assumption, Structure, choose_rule

Array = NDArray[np.float64]
RUNS = 40
SELECTIVE = [rule for rule in RULES if rule != "matrix"]  # those that join some of the estimates


def estimates(rule: str, size: int = 3) -> tuple[Array, Array]:
    """Means (l, n, N) and a joint covariance (l, l, n, n, N) of a rule's number of estimates."""
    count = 2 if RULES[rule].pair else 3
    generator = np.random.default_rng(count)
    factor = generator.normal(size=(RUNS, count * size, count * size + 1))
    joint = (factor @ factor.swapaxes(1, 2)).reshape(RUNS, count, size, count, size)
    return generator.normal(size=(count, size, RUNS)), joint.transpose(1, 3, 2, 4, 0)


def silences(count: int) -> NDArray[np.bool_]:
    """Who takes part (l, N): every set of estimates, nobody in lane 0."""
    return (np.arange(RUNS) >> np.arange(count)[:, None]) % 2 == 1


@pytest.mark.parametrize("rule", RULES)
def test_gains_make_the_mean_and_add_up_to_one(rule: str) -> None:
    means, joint = estimates(rule)
    fused = RULES[rule].make().fuse(means, joint)
    identity = np.broadcast_to(np.eye(3)[..., None], fused.covariance.shape)
    np.testing.assert_allclose(fused.gains.sum(0), identity, atol=1e-9)
    np.testing.assert_allclose(
        np.einsum("lijN,ljN->iN", fused.gains, means), fused.mean, rtol=1e-7, atol=1e-9
    )
    assert fused.gains is fused.gains  # computed once
    if fused.weights is not None:
        np.testing.assert_allclose(fused.weights.sum(0), 1.0)


@pytest.mark.parametrize("rule", SELECTIVE)
def test_the_silent_are_not_read_and_count_for_nothing(rule: str) -> None:
    """Each lane is what the active estimates alone give; nobody gives nothing."""
    means, joint = estimates(rule)
    active, fusion = silences(len(means)), RULES[rule].make()
    dirty, pairs = np.where(active[:, None], means, np.nan), active[:, None] & active
    fused = fusion.fuse(dirty, np.where(pairs[:, :, None, None], joint, np.nan), active)
    for run in range(RUNS):
        who, lane = np.flatnonzero(active[:, run]), slice(run, run + 1)
        if not who.size:
            assert np.isnan(fused.mean[:, run]).all()
            assert np.isnan(fused.covariance[..., run]).all()
            continue
        expected = fusion.fuse(means[who][..., lane], joint[np.ix_(who, who)][..., lane])
        np.testing.assert_allclose(fused.mean[:, lane], expected.mean, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(fused.covariance[..., lane], expected.covariance, rtol=1e-9)
        np.testing.assert_allclose(fused.gains[who][..., lane], expected.gains, atol=1e-9)
        assert not fused.gains[~active[:, run]][..., run].any()


@pytest.mark.parametrize("rule", RULES)
def test_a_covariance_is_claimed_where_the_assumption_holds(rule: str) -> None:
    """For this joint covariance, of errors that are correlated in no special way."""
    means, joint = estimates(rule)
    fused = RULES[rule].make().fuse(means, joint)
    actual = np.einsum("aijN,abjkN,blkN->ilN", fused.gains, joint, fused.gains)
    margin = np.linalg.eigvalsh(np.moveaxis(fused.covariance - actual, -1, 0))[:, 0]
    scale = np.einsum("iiN->N", actual)
    if RULES[rule].assumes in ("nothing", "tracked weights"):
        assert np.all(margin >= -1e-7 * scale)
    elif RULES[rule].assumes == "joint covariance":
        np.testing.assert_allclose(fused.covariance, actual, atol=1e-9 * scale.max())
    else:
        assert margin.min() < -0.01 * scale.min()


@pytest.mark.parametrize("assumption", REASONS)
def test_a_rule_is_refused_for_its_reason_and_taken_where_its_assumption_holds(
    assumption: Assumption,
) -> None:
    for name, rule in RULES.items():
        if rule.assumes == assumption:
            with pytest.raises(ConfigurationError) as refused:
                choose_rule(name, Structure(common="all contain the same noise"), 2)
            message = str(refused.value)
            assert message.startswith(f"fusion = {name!r} is not allowed: it must be one of ")
            assert REASONS[assumption].format(common="all contain the same noise") in message
            assert "'sci'" in message
            choose_rule(name, Structure("nothing at all", (assumption,)), 2)


def test_assumptions_are_known_by_name() -> None:
    names = get_args(Assumption)
    assert {rule.assumes for rule in RULES.values()} <= set(names)
    assert set(REASONS) < set(names)


@pytest.mark.parametrize("name", ["cii", "", 3, None, ["ci"]])
def test_an_unknown_rule_is_refused(name: Any) -> None:
    structure = Structure("all contain the same noise")
    known = ", ".join(map(repr, structure.offered))
    with pytest.raises(ConfigurationError, match=f"fusion = .* one of {known}"):
        choose_rule(name, structure, 2)


def test_the_prediction_comes_before_the_sensors() -> None:
    noise = "all contain the same noise"
    for prediction, order in ((True, (0, 3, 1, 2)), (False, (2, 0, 1))):
        rule = choose_rule("sci", Structure(noise, prediction=prediction), 3, [2, 0, 1])
        assert isinstance(rule, SequentialIntersection)
        assert rule.order == order
    choose_rule("ici", Structure(noise, prediction=True), 1)
    with pytest.raises(ConfigurationError, match=r"2 sensors: .*prediction.* 'sici'"):
        choose_rule("ici", Structure(noise, prediction=True), 2)


@pytest.mark.parametrize("rule", SELECTIVE)
def test_one_alone_everywhere_is_kept(rule: str) -> None:
    means, joint = estimates(rule)
    active = np.zeros((len(means), RUNS), dtype=np.bool_)
    active[1] = True
    fused = RULES[rule].make().fuse(means, joint, active)
    np.testing.assert_allclose(fused.mean, means[1], rtol=1e-9)
    np.testing.assert_allclose(fused.covariance, joint[1, 1], rtol=1e-9)


def test_the_joint_covariance_needs_every_estimate() -> None:
    means, joint = estimates("matrix")
    with pytest.raises(ValueError, match="it joins all estimates"):
        RULES["matrix"].make().fuse(means, joint, silences(len(means)))
