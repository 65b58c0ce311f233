"""Censored sensors and Tobit Kalman filters: tobit_token_bucket and round_robin_tobit."""
