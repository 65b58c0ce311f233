"""Trainings: configs, algorithms, models, monitoring."""
