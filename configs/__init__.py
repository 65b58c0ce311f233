"""Shipped configs of trainings, sweeps, tables and the benchmark."""
