"""The simulation sections of the five papers: simulations, figures, claims and their verdicts.

Each paper has a module with simulations, numbers and figures, another one with its claims, and a
page: Markdown with fields for numbers (Jinja).
"""
