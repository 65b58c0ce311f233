"""What Gymnasium, Stable-Baselines3 and PettingZoo see of the batched core."""
