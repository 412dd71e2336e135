"""Train Stable-Baselines3's PPO on images: python examples/train_ppo.py [--steps N] [--equivariant].

PPO takes Dict observations as they are; it only needs an extractor that takes heightmaps for the images they
are.
"""

import argparse
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.encoders.extractors import CnnExtractor, EquivariantExtractor

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
CNN: dict[str, Any] = {
    "features_extractor_class": CnnExtractor,
    "features_extractor_kwargs": {"channels": [8, 16, 32, 64, 64]},
}
# The features rotate with the scene; PPO's own head behind them is not equivariant.
EQUIVARIANT: dict[str, Any] = {
    "features_extractor_class": EquivariantExtractor,
    "features_extractor_kwargs": {"n": 4, "channels": [4, 8, 16, 32, 32], "output": "regular"},
}


def main() -> None:
    """Train, and print the share of successful episodes: the reward is 1 for success."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=50_000, help="time steps over all environments")
    parser.add_argument("--rollout", type=int, default=128, help="steps of an environment between updates")
    parser.add_argument("--equivariant", action="store_true", help="use features that rotate with the scene")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of the evaluation")
    args = parser.parse_args()
    env = make_vec_env(ENV_ID, n_envs=4, seed=0, env_kwargs={"obs_size": 64})
    policy_kwargs = EQUIVARIANT if args.equivariant else CNN
    model = PPO("MultiInputPolicy", env, n_steps=args.rollout, policy_kwargs=policy_kwargs, verbose=1, seed=0)
    model.learn(args.steps)
    success, _ = evaluate_policy(model, env, args.episodes)
    print(f"success rate {success:.2f}")


if __name__ == "__main__":
    main()
