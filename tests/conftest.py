"""Settings for all tests."""

from __future__ import annotations

import torch

# Two test processes share two cores: more threads would only wait for each other.
torch.set_num_threads(1)
