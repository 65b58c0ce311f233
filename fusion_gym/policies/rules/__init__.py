"""Analytic policies, from signals to requests, one rule or pair of rules a file."""
