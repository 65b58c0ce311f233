"""The simulation sections of the five papers: simulations, figures, claims and their verdicts.

Each paper has a module, which simulates, computes and draws, and a page of the same name beside it,
a Jinja template with its prose, claims, tables and captions.
"""
