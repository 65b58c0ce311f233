"""The checkpoint: one file from which a training goes on as if it had not been interrupted.

It is the archive that Stable-Baselines3 writes, and in it also what that leaves out: the states of
all random generators, the episodes under way, a recurrent policy's memory, the replay buffer, the
best model so far and the journal. Being one file, it is replaced in one move.

Stable-Baselines3's loader and the states are pickles: a checkpoint is for going on with one's own
training, and is not to be taken from others.
"""

import json
import pickle
import random
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from fusion_gym.envs.sb3 import FusionSB3VecEnv
from fusion_gym.output.files import DAMAGED, replacing
from fusion_gym.validation import ConfigurationError

# Entries of the archive beside those of Stable-Baselines3.
_JOURNAL, _STATE, _BEST = "journal.json", "state.pkl", "best_model.zip"
# What Stable-Baselines3 leaves out of its archive: DQN's memory, and that of a recurrent policy.
_LEFT_OUT = ("replay_buffer", "_last_lstm_states")


@dataclass
class Journal:
    """What a training has done so far.

    ``inputs`` is what it was made from, ``records`` are its validations, ``seconds`` the wall time
    by activity and ``cpu_seconds`` the processor's, validation apart, over all stretches; ``best``
    is the best model's file.
    """

    inputs: dict[str, Any]
    records: list[dict[str, Any]] = field(default_factory=list)
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
    """Write the checkpoint; between rollouts, for a rollout under way is no part of it."""
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
    """The journal of a checkpoint; every entry of the file is checked against its sum.

    Nothing is unpickled.

    Raises:
        ConfigurationError: the file is damaged, or no checkpoint.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
            if broken is not None:
                raise zipfile.BadZipFile(f"{broken} is damaged")
            content = json.loads(archive.read(_JOURNAL))
            best = archive.read(_BEST) if _BEST in archive.namelist() else None
        return Journal(**content, best=best)
    except DAMAGED as error:
        reason = " ".join(str(error).split()).strip("'\"")
        raise ConfigurationError(
            f"checkpoint = {str(path)!r} cannot be gone on with: {reason}"
        ) from None


def restore(path: Path, kind: type[BaseAlgorithm], env: FusionSB3VecEnv) -> BaseAlgorithm:
    """The model of a checkpoint; environment and random generators are put back in their states."""
    model = kind.load(path, env=env, device="cpu", force_reset=False)
    with zipfile.ZipFile(path) as archive, archive.open(_STATE) as file:
        state = pickle.load(file)
    env.restore(state["env"])
    for name, value in state["model"].items():
        setattr(model, name, value)
    # Last, for loading a model seeds them anew.
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    model.action_space.np_random.bit_generator.state = state["actions"]
    return model


def _state(model: BaseAlgorithm, env: FusionSB3VecEnv) -> dict[str, Any]:
    """What Stable-Baselines3 does not save, though a training depends on it."""
    return {
        "env": env.snapshot(),
        "model": {name: vars(model)[name] for name in _LEFT_OUT if name in vars(model)},
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002
        "torch": torch.get_rng_state(),
        "actions": model.action_space.np_random.bit_generator.state,
    }
