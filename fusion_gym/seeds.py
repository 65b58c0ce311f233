"""The seeds of episodes: one range for each purpose, disjoint from all others."""

TEST = range(0, 20_000_000)  # figures of evaluations and comparisons
SCALE = range(20_261_124, 20_261_156)  # of the reward
VALIDATION = range(500_000_000, 600_000_000)  # during a training
TUNING = range(600_000_000, 700_000_000)  # thresholds of the benchmark's rules
FIELD = range(700_000_000, 800_000_000)  # rules of a study of a log
CALIBRATION = range(800_000_000, 900_000_000)  # agents at every price
EXPORT = range(950_000_000, 1_000_000_000)  # the check of an ONNX file
# Training of agents and search of rules: no figure is measured on the seeds of either. A training
# begins at TRAINING[STRIDE * seed].
STRIDE = 10_000_019
TRAINING = range(1_000_000_000, 1_000_000_000 + STRIDE * 2**32)
