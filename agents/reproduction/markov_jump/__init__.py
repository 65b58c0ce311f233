"""Fusion of event-triggered estimates of a Markov jump system: Section 6 anew, Figures 2 to 5."""
