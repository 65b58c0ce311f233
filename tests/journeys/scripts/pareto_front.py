import numpy as np

import fusion_gym

agent = "tobit_oscillator_scheduler"
card = fusion_gym.zoo.card(agent)
task = fusion_gym.make_task(card["env"], **card["options"])


def run(name):
    policy = fusion_gym.make_policy(name, task)
    return fusion_gym.evaluation.run_episodes(task, policy)


thresholds = [f"innovation_threshold:threshold={value:.2f}" for value in np.geomspace(0.5, 3, 10)]
rules = {name: run(name) for name in ("never", "always", *thresholds)}
for name, rate, mse in fusion_gym.evaluation.lower_envelope(rules):
    print(f"{rate:.3f}  {mse:.3f}  {name}")
for price in (0.02, 0.2, 2.0):
    results = run(f"zoo:{agent},price={price}")
    error = fusion_gym.evaluation.envelope_error(rules, results.rate.mean())
    difference = fusion_gym.evaluation.mean_interval(results.mse - error)
    print(f"{results.rate.mean():.3f}  {results.mse.mean():.3f}  price {price}", difference)
