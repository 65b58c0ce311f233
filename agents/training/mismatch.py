"""What a training on the mismatch is told before it begins, where that is not the error."""

from __future__ import annotations

from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.evaluation.cross_term import cross_terms, usual_policies, worst
from fusion_gym.policies.registry import make_policy

from ..output.progress import remark
from .config import Experiment

EPISODES = 150  # of each of two policies: a second or two in the slowest environment
SEED = 700_000_000  # far from the seeds of trainings, validations, tuning and tests
LEVEL = 0.99  # of the intervals together: one of a hundred settings is warned of for nothing


def warn_of_cross_term(experiment: Experiment, env: FusionSB3VecEnv) -> None:
    """Print the cross term, with its interval, if that says that it is not zero.

    Two policies are measured: random requests at the rate at which the training begins, or to
    which it goes, and the one of the greatest value that the environment knows.
    """
    task, reference = env.task, env.batch.reference
    assert reference is not None  # the environment of such a training has one
    begins = getattr(experiment.algorithm, "initial_rate", None)
    rate = experiment.training.target_rate or begins or 0.5
    usual = usual_policies(task, (rate,))
    policies = {name: make_policy(name, task) for name in (usual[0], usual[-1])}
    name, found = worst(cross_terms(task, reference, policies, EPISODES, SEED, LEVEL))
    if not found.compatible:
        remark(
            f"warning: training.error = 'mismatch' leaves out a cross term of {found.shown} of the "
            f"error under {name} ({EPISODES} episodes); error: excess has none, and the command "
            "mismatch measures it under other policies and filters"
        )
