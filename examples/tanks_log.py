"""Write fusion_gym/recordings/tanks.csv: levels of three tanks from a known plant.

    python examples/tanks_log.py

The third sensor reads every fourth minute, the second saturates at 54 cm, and 3 % of the readings
are lost. A and W are the plant's matrices.
"""

from pathlib import Path

import numpy as np
import pandas as pd

A = np.array([[0.92, 0.05, 0.0], [0.04, 0.9, 0.05], [0.0, 0.06, 0.93]])
W = np.array([[1.0, 0.2, 0.0], [0.2, 0.8, 0.1], [0.0, 0.1, 0.5]])
LEVEL = np.array([40.0, 45.0, 30.0])
ROWS = 6000


def main() -> None:
    """Simulate the tanks, and write what their sensors record."""
    draw = np.random.default_rng(0)
    noise = draw.multivariate_normal(np.zeros(3), W, ROWS)
    level = np.zeros((ROWS, 3))
    for row in range(1, ROWS):
        level[row] = A @ level[row - 1] + noise[row]
    level += LEVEL
    level[:, 1] = np.minimum(level[:, 1], 54.0)
    level[draw.random(level.shape) < 0.03] = np.nan
    level[np.arange(ROWS) % 4 > 0, 2] = np.nan
    heads = "inflow [cm]", "middle [cm] 0..54", "outflow [cm]"
    times = pd.date_range("2026-01-01", periods=ROWS, freq="min", name="time")
    table = pd.DataFrame(level.round(2), index=times, columns=heads)
    table.to_csv(Path("fusion_gym/recordings/tanks.csv"))


if __name__ == "__main__":
    main()
