"""Joint input and state filters under an adaptive threshold: Figures 1 to 7 and the theorems."""
