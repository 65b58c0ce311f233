"""The base class of the callbacks of a training."""

from stable_baselines3.common.callbacks import BaseCallback

from fusion_gym.envs.sb3 import FusionSB3VecEnv


class Callback(BaseCallback):
    """A callback between rollouts, with access to the training's environment."""

    @property
    def environment(self) -> FusionSB3VecEnv:
        """The environment without wrappers."""
        env = self.training_env.unwrapped
        assert isinstance(env, FusionSB3VecEnv)
        return env

    def _on_step(self) -> bool:
        return True
