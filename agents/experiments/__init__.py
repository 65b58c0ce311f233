"""Many policies beside each other: sweeps, the benchmark's work, tuning, the verdict."""
