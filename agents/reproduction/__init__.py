"""The simulation sections of the five papers, made anew: figures, tables, claims, verdicts."""
