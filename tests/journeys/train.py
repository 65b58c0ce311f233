from stable_baselines3 import PPO

import fusion_gym

env_id, options = "fusion_gym/TobitOscillator-v1", {"filter": "tobit", "cost_weight": 0.03}
envs = fusion_gym.make_sb3_vec_env(env_id, num_envs=128, seed=0, **options)
model = PPO("MlpPolicy", envs, n_steps=32, batch_size=1024, gamma=0.95, seed=0)
model.learn(50_000).save("agent.zip")

task = fusion_gym.make_task(env_id, **options)
for name in ("periodic:period=6", "model:agent.zip"):
    policy = fusion_gym.make_policy(name, task)
    results = fusion_gym.evaluation.run_episodes(task, policy, episodes=200, seed=0)
    print(name, results.rate.mean(), fusion_gym.evaluation.mean_interval(results.returns))
