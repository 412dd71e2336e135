"""Train sb3-contrib's CrossQ on images: python examples/train_crossq.py [--steps N].

CrossQ takes no Dict observations; ``ImageObservation`` makes one image of them.
"""

import argparse

from sb3_contrib import CrossQ
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from bulletarm_gym.wrappers import ImageObservation
from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.replay.buffer import ExpertReplayBuffer

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"


def main() -> None:
    """Train, and print the share of successful episodes: the reward is 1 for success."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000, help="time steps over all environments")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of the evaluation")
    args = parser.parse_args()
    env = make_vec_env(ENV_ID, 1, seed=0, env_kwargs={"obs_size": 64}, wrapper_class=ImageObservation)
    model = CrossQ(
        "MlpPolicy",
        env,
        buffer_size=20_000,
        batch_size=64,
        replay_buffer_class=ExpertReplayBuffer,  # every image once, as one byte a pixel
        policy_kwargs={
            "features_extractor_class": CnnExtractor,
            "features_extractor_kwargs": {"channels": [8, 16, 32, 64, 64]},
            "net_arch": {"pi": [64], "qf": [256]},
        },
        verbose=1,
        seed=0,
    )
    model.learn(args.steps)
    success, _ = evaluate_policy(model, env, args.episodes)
    print(f"success rate {success:.2f}")


if __name__ == "__main__":
    main()
