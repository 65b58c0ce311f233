"""Read the archive of a Stable-Baselines3 model as data: plain JSON and weights.

The loader of Stable-Baselines3 unpickles the entries ``:serialized:`` of the archive's ``data``,
which runs code of the file. This module leaves such entries as text. Of the ``.pth`` files it reads
only the weights of the policy, by torch's loader of plain weights.
"""

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import torch

from fusion_gym.entries import Plain
from fusion_gym.validation import ConfigurationError

LARGEST = 256 * 2**20  # bytes of a part, and of all weights
MOST = 1_000  # tensors
# Errors of zipfile on a damaged archive; RuntimeError where a part is encrypted.
DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    OSError,
    EOFError,
    RuntimeError,
    UnicodeError,
    struct.error,
)


class NeedsTrust(ConfigurationError):
    """A file that plain JSON and weights cannot restore; only its own code could load it."""


def read_plain(file: Path, name: str = "data") -> Plain:
    """Return a JSON object of the archive, with pickled entries as text."""
    content = read_part(file, name)
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        raise _none(f"its {name} is not JSON") from None
    if not isinstance(data, dict):
        raise _none(f"its {name} is not a JSON object")
    return data


def read_weights(file: Path) -> dict[str, torch.Tensor]:
    """Return the policy's weights by name, finite float32."""
    part = read_part(file, "policy.pth")
    try:
        with zipfile.ZipFile(io.BytesIO(part)) as packed:
            stored = all(item.compress_type == zipfile.ZIP_STORED for item in packed.infolist())
        data = torch.load(io.BytesIO(part), "cpu", weights_only=True) if stored else None
    except Exception:  # a crafted file may raise any error
        raise NeedsTrust("its policy.pth holds more than plain weights") from None
    if not stored:
        raise NeedsTrust("its weights are compressed")
    if not isinstance(data, dict) or len(data) > MOST or not all(map(_is_plain, data.values())):
        raise NeedsTrust("its policy.pth is not a table of float32 weights")
    size = 4 * sum(weight.numel() for weight in data.values())
    if size > LARGEST:
        raise NeedsTrust(f"its weights have {size} bytes, more than {LARGEST}")
    if not all(bool(torch.isfinite(weight).all()) for weight in data.values()):
        raise _none("its weights are not finite")
    # Copies, because the tensors of a file may share memory.
    return {str(name): weight.clone() for name, weight in data.items()}


def read_part(file: Path, name: str) -> bytes:
    """Return a part of the archive, up to its declared size."""
    try:
        with zipfile.ZipFile(file) as archive:
            about = archive.getinfo(name)
            if about.file_size > LARGEST:
                raise NeedsTrust(f"its {name} has {about.file_size} bytes, more than {LARGEST}")
            if about.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise NeedsTrust(f"its {name} has an unusual compression")
            with archive.open(about) as part:
                return part.read(about.file_size)
    except KeyError:
        raise _none(f"it has no {name}") from None
    except DAMAGE as error:
        raise _none(" ".join(str(error).split())[:100]) from None


def _is_plain(weight: Any) -> bool:
    if type(weight) is not torch.Tensor:
        return False
    kind = (weight.layout, weight.dtype, weight.device.type)
    return kind == (torch.strided, torch.float32, "cpu")


def _none(reason: str) -> ConfigurationError:
    return ConfigurationError(f"it is not a Stable-Baselines3 model ({reason})")
