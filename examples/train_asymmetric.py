"""Train an actor on camera images and its critic on poses: python examples/train_asymmetric.py."""

import argparse
from typing import Any

import gymnasium
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.encoders.extractors import CnnExtractor
from sb3_extensions.encoders.mlp_extractor import MlpExtractor
from sb3_extensions.sacfd import MultiInputPolicy, SACfD

CAMERA = {"sensor": "rgb", "size": 64, "shadow": False}
SENSORS = ["state", {"name": "front", **CAMERA}, {"name": "wrist", "mount": "wrist", **CAMERA}, "holding"]


class AsymmetricPolicy(MultiInputPolicy):
    """Policy whose actor observes everything except ``state``, and whose critic observes ``state`` only."""

    def make_actor(self, features_extractor: Any = None) -> Any:
        """Create the actor."""
        images = {key: space for key, space in self.observation_space.items() if key != "state"}
        return super().make_actor(CnnExtractor(spaces.Dict(images), channels=[8, 16, 32, 64, 64]))

    def make_critic(self, features_extractor: Any = None) -> Any:
        """Create the critic."""
        return super().make_critic(MlpExtractor(spaces.Dict({"state": self.observation_space["state"]})))


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=1_000)
parser.add_argument("--expert-episodes", type=int, default=50)
parser.add_argument("--episodes", type=int, default=50, help="episodes of the evaluation")
args = parser.parse_args()
env = gymnasium.make("BulletArm/CloseLoopBlockReaching-v0", observation=SENSORS)
model = SACfD(AsymmetricPolicy, env, expert_episodes=args.expert_episodes, seed=0).learn(args.steps)
print(f"success rate {evaluate_policy(model, env, args.episodes, warn=False)[0]:.2f}")
