"""Every policy: trigger rules, reference policies and saved agents.

A policy declares the least class of :mod:`fusion_gym.core.knowledge` that has every signal it uses.
A test changes all other signals and requires bitwise equal requests.

The classes with memory use unsent measurements. Three triggers of papers belong to them although
they store one number or one measurement per sensor: ``dynamic_event`` and ``adaptive_threshold``
update their thresholds with unsent measurements, and ``dynamic_event`` and ``adaptive_innovation``
store a request that the network denied. ``adaptive_innovation`` has no memory where every request
is granted.
"""
