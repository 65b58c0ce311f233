"""Tobit Kalman fusion filtering with a token bucket: Section 4 made anew, Figures 2 to 10."""
