from stable_baselines3 import PPO

import fusion_gym

env_id = "fusion_gym/LinearFusion-v2"
envs = fusion_gym.make_sb3_vec_env(env_id, num_envs=128, seed=0)
model = PPO("MlpPolicy", envs, 1e-3, n_steps=32, batch_size=512, gamma=0.95, seed=0)
model.learn(300_000).save("agent.zip")

task = fusion_gym.make_task(env_id)
thresholds = (0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.7)
sweep = [f"innovation_threshold:threshold={value},at_most=1" for value in thresholds]
for name in ("always", "periodic:period=8", *sweep, "model:agent.zip"):
    policy = fusion_gym.make_policy(name, task)
    results = fusion_gym.evaluation.run_episodes(task, policy, episodes=400, seed=0)
    mean, low, high = fusion_gym.evaluation.mean_interval(results.returns)
    print(f"{name:45} {results.rate.mean():.3f}  {mean:7.1f} [{low:.1f}, {high:.1f}]")
