from stable_baselines3 import PPO

import fusion_gym

env_id = "fusion_gym/LinearFusion-v2"
envs = fusion_gym.make_sb3_vec_env(env_id, num_envs=128, seed=0)
model = PPO("MlpPolicy", envs, 1e-3, n_steps=32, batch_size=512, gamma=0.95, seed=0)
model.learn(300_000).save("agent.zip")

task = fusion_gym.make_task(env_id)
for name in ("always", "innovation_threshold:threshold=1,at_most=1", "model:agent.zip"):
    policy = fusion_gym.make_policy(name, task)
    results = fusion_gym.evaluation.run_episodes(task, policy, episodes=400)
    means = results.returns.mean(), results.mse.mean(), results.tokens.mean()
    print("{:43} return {:7.1f}  MSE {:.3f}  tokens {:.2f}".format(name, *means))
