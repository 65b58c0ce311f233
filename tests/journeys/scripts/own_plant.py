import gymnasium as gym

import fusion_gym

gym.register(
    "mine/Rooms-v0",
    entry_point="fusion_gym.envs.registered:LinearFusionEnv",
    kwargs={
        "transition": [[0.95, 0.04], [0.04, 0.95]],
        "process_covariance": [[0.04, 0.0], [0.0, 0.01]],
        "measurement_matrices": [[1, 0], [0, 1]],
        "measurement_covariances": 0.01,
        "token_rate": 1.0,
    },
)
env = gym.make("mine/Rooms-v0", token_rate=2.0)
print(env.reset(seed=0)[0])

task = fusion_gym.make_task("mine/Rooms-v0")
for name in ("periodic:period=6", "innovation_threshold:threshold=0.5"):
    policy = fusion_gym.make_policy(name, task)
    results = fusion_gym.evaluation.run_episodes(task, policy)
    print(name, results.rate.mean(), results.mse.mean())
