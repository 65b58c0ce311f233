"""The zoo: one trained agent a class, small and ready to use."""
