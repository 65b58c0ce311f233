"""The checkpoint: one file from which a training continues as if it had not been interrupted.

It is the archive of Stable-Baselines3 with further parts: the states of all random generators, the
running episodes, the memory of a recurrent policy, the replay buffer, the best model so far and the
journal. One file can be replaced atomically.

The states and the archive's entries are pickles. Load only checkpoints of your own trainings.
"""

import json
import pickle
import random
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypedDict

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from fusion_gym.entries import Plain, State
from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.output.files import replacing
from fusion_gym.policies.archive import DAMAGE
from fusion_gym.validation import ConfigurationError

DAMAGED = (*DAMAGE, KeyError, TypeError, ValueError)  # errors from a damaged checkpoint
# Additional entries of the archive.
_JOURNAL, _STATE, _BEST = "journal.json", "state.pkl", "best_model.zip"
# Attributes that Stable-Baselines3 does not save: replay buffer and recurrent memory.
_LEFT_OUT = ("replay_buffer", "_last_lstm_states")


ValidationRecord = TypedDict(
    "ValidationRecord",
    {
        "timesteps": int,
        "return": float,
        "mse": float,
        "rate": float,
        "relative_cost": float,
        "prices": list[dict[str, float]],
    },
)


@dataclass
class Journal:
    """The progress of a training.

    Args:
        inputs: inputs of the training.
        records: its validations.
        seconds: wall time by activity, over all parts of the training.
        cpu_seconds: processor time without validation, over all parts of the training.
        best: file of the best model.
    """

    inputs: Plain
    records: list[ValidationRecord] = field(default_factory=list)
    seconds: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(
            ("environment", "policy", "update", "validation"), 0.0
        )
    )
    cpu_seconds: float = 0.0
    best: bytes | None = None


def save_checkpoint(
    path: Path, model: BaseAlgorithm, env: FusionSB3VecEnv, journal: Journal
) -> None:
    """Write the checkpoint between two rollouts; it does not include a rollout in progress."""
    content = asdict(journal)
    best = content.pop("best")
    with replacing(path) as partial:
        model.save(partial)
        with zipfile.ZipFile(partial, "a") as archive:
            archive.writestr(_JOURNAL, json.dumps(content))
            if best is not None:
                archive.writestr(_BEST, best)
            with archive.open(_STATE, "w", force_zip64=True) as file:
                pickle.dump(_state(model, env), file, pickle.HIGHEST_PROTOCOL)


def read_journal(path: Path) -> Journal:
    """Return the journal of a checkpoint after a check of all checksums, without unpickling."""
    try:
        with zipfile.ZipFile(path) as archive:
            if broken := archive.testzip():
                raise zipfile.BadZipFile(f"{broken} is damaged")
            content = json.loads(archive.read(_JOURNAL))
            best = archive.read(_BEST) if _BEST in archive.namelist() else None
        return Journal(**content, best=best)
    except DAMAGED as error:
        reason = " ".join(str(error).split()).strip("'\"")
        raise ConfigurationError(
            f"checkpoint = {str(path)!r} cannot be continued: {reason}"
        ) from None


def restore(path: Path, kind: type[BaseAlgorithm], env: FusionSB3VecEnv) -> BaseAlgorithm:
    """Return the model of a checkpoint, and restore the environment and all random generators."""
    model = kind.load(path, env=env, device="cpu", force_reset=False)
    with zipfile.ZipFile(path) as archive, archive.open(_STATE) as file:
        state = pickle.load(file)
    env.restore(state["env"])
    for name, value in state["model"].items():
        setattr(model, name, value)
    # Last, because loading a model seeds them.
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    model.action_space.np_random.bit_generator.state = state["actions"]
    return model


def _state(model: BaseAlgorithm, env: FusionSB3VecEnv) -> State:
    """Return the state of a training that Stable-Baselines3 does not save."""
    return {
        "env": env.snapshot(),
        "model": {name: vars(model)[name] for name in _LEFT_OUT if name in vars(model)},
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002
        "torch": torch.get_rng_state(),
        "actions": model.action_space.np_random.bit_generator.state,
    }
