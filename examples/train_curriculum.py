"""Train SAC on cubes of more and more sizes: python examples/train_curriculum.py [--steps N]."""

import argparse

from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from bulletarm_gym.wrappers import ResetOptions

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
ENV_KWARGS = {"observation": "state", "object_scale_range": [0.6, 1.0], "randomization": "light"}


class Curriculum(BaseCallback):
    """Extend the range of scales from 1 to [0.6, 1] in the first half of the training."""

    def _on_step(self) -> bool:
        share = min(1.0, 2.0 * self.num_timesteps / self.locals["total_timesteps"])
        scales = [1.0 - 0.4 * share, 1.0]
        self.training_env.env_method("set_reset_options", {"object_scale_range": scales})
        return True


def main() -> None:
    """Train, and print the success rate over all sizes: the reward is 1 for success."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000, help="time steps over all environments")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of the evaluation")
    args = parser.parse_args()
    env = make_vec_env(ENV_ID, 2, seed=0, env_kwargs=ENV_KWARGS, wrapper_class=ResetOptions)
    model = SAC("MultiInputPolicy", env, learning_starts=100, verbose=1, seed=0)
    model.learn(args.steps, Curriculum())
    success, _ = evaluate_policy(model, env, args.episodes)
    print(f"success rate {success:.2f}")


if __name__ == "__main__":
    main()
