"""Trainings: configs, algorithms, models, monitoring."""

EPISODES = 16, 400  # of all candidates of a calibration, and of the best, the rule and the agents
