"""The zoo: one trained agent per class."""
