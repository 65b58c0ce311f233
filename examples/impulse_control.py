"""An integrator reset by impulses: event-triggered control against periodic control.

At equal rate the variance tends to a third of periodic control's: K. J. Åström and B. Bernhardsson,
"Comparison of Riemann and Lebesgue sampling for first order stochastic systems", CDC 2002.
"""

import fusion_gym
from fusion_gym.evaluation import run_episodes

# x(t+1) = x(t) + u(t) + w(t), w ~ N(0, 1): the gain 1 resets x to zero wherever it is known
task = fusion_gym.make_task(
    "fusion_gym/LinearFusion-v2",
    transition=[[1.0]],
    input_matrix=[[1.0]],
    gain=[[1.0]],
    control_weights=([[1.0]], [[1e-9]]),
    process_covariance=[[1.0]],
    measurement_matrices=[[1.0]],
    measurement_covariances=1e-9,
    initial_covariance=[[0.0]],
    tokens="unlimited",
    horizon=10_000,
    reward_scale=None,
)

print("policy                             interval  variance  periodic's  ratio")
for policy in ["periodic:period=10", "periodic:period=100"] + [
    f"innovation_threshold:threshold={threshold}" for threshold in (3, 10, 20)
]:
    results = run_episodes(task, fusion_gym.make_policy(policy, task), 100, seed=0)
    interval, variance = 1.0 / results.rate.mean(), results.control_cost
    periodic = (interval + 1.0) / 2.0  # the mean of 1, …, interval
    ratio, half = variance.mean() / periodic, 0.196 * variance.std(ddof=1) / periodic
    print(f"{policy:33s}  {interval:8.1f}  {variance.mean():8.2f}  {periodic:10.2f}  ", end="")
    print(f"{ratio:.3f} ± {half:.3f}")
