"""The simulation sections of the five papers: simulations, figures, claims and their verdicts.

Each paper has a module with simulations, numbers and figures, and a Jinja template of the same name
with prose, claims, tables and captions.
"""
