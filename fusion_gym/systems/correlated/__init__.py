"""Correlated noises known by bounds, robust filters: adaptive_innovation."""
