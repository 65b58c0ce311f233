"""Every policy: rules, references that know the model, saved agents.

Each declares the least class of :mod:`fusion_gym.core.system` that knows all that it looks at,
and a test holds it to that: what lies outside is changed, and its requests stay bitwise equal.

The classes with memory are about what a sensor measured and did not deliver. Three papers' triggers
are of that kind although they keep only a number or a measurement for each sensor:
``dynamic_event`` and ``adaptive_threshold`` move their thresholds with unsent measurements, and
``dynamic_event`` and ``adaptive_innovation`` remember a request that the network denied. The
second is memoryless wherever every request is granted.
"""
