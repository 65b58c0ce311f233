import fusion_gym

task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", filter="tobit", token_rate=2.0)
print(f"{'policy':33} rate    MSE, 95 % interval")
for name in ("never", "periodic:period=6", "innovation_threshold:threshold=2", "always"):
    policy = fusion_gym.make_policy(name, task)
    results = fusion_gym.evaluation.run_episodes(task, policy, episodes=200, seed=0)
    mse = fusion_gym.evaluation.mean_interval(results.mse)
    print(f"{name:33} {results.rate.mean():.3f}  {mse.mean:.3f} [{mse.low:.3f}, {mse.high:.3f}]")
