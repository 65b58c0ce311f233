"""The simulation section of round_robin_tobit: Figures 2 to 11, Tables II and III, the claims."""
