"""Benchmarks: performance as ratios within one run."""
