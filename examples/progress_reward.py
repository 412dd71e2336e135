"""Train SAC from states: python examples/progress_reward.py [--task NAME] [--sparse] [--steps N]."""

import argparse

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import bulletarm_gym  # noqa: F401 (registers the environments)


def main() -> None:
    """Train, and print the share of successes in the last episodes of the training."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="BlockReaching")
    parser.add_argument("--sparse", action="store_true", help="without the reward for progress")
    parser.add_argument("--steps", type=int, default=4_000)
    parser.add_argument("--episodes", type=int, default=50, help="number of the last episodes, at most 100")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    kwargs = {"observation": "state", "reward": None if args.sparse else "progress"}
    env_id = f"BulletArm/CloseLoop{args.task}-v0"
    env = VecNormalize(make_vec_env(env_id, seed=args.seed, env_kwargs=kwargs), gamma=0.99)
    learning = {"learning_rate": 1e-3, "batch_size": 64, "gamma": 0.99, "ent_coef": "auto_0.1"}
    network = {"net_arch": [64, 64]}
    model = SAC("MultiInputPolicy", env, policy_kwargs=network, verbose=1, seed=args.seed, **learning)
    model.learn(args.steps, log_interval=20)
    print(f"success rate {np.mean(list(model.ep_success_buffer)[-args.episodes :]):.2f}")


if __name__ == "__main__":
    main()
