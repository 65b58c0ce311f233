"""Trigger rules from signals to requests, one rule or pair of rules per module."""
