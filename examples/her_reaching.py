"""Train reaching with hindsight experience replay: python examples/her_reaching.py [--steps N]."""

import argparse

import gymnasium
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from bulletarm_gym.wrappers import GoalObservation
from sb3_extensions.encoders.mlp_extractor import MlpExtractor

ENV_ID = "bulletarm_gym:BulletArm/CloseLoopBlockReaching-v0"
SENSORS = {"observation": ["holding"], "action_sequence": "pxyz", "max_steps": 20}  # goals have the positions
NETWORK = {
    "net_arch": [64],
    "features_extractor_class": MlpExtractor,
    "features_extractor_kwargs": {"layers": [64], "standardise": [0.0, 0.1]},  # tenths of a metre
}


def main() -> None:
    """Train, and print the share of episodes that reach the goal: the reward is 1 at the goal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=5_000)
    parser.add_argument("--episodes", type=int, default=50, help="episodes of the evaluation")
    args = parser.parse_args()
    env = Monitor(GoalObservation(gymnasium.make(ENV_ID, **SENSORS)))
    replay = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 300, "batch_size": 64}
    learning = {"learning_rate": 1e-3, "gamma": 0.9, "ent_coef": "auto_0.1"}
    model = SAC("MultiInputPolicy", env, policy_kwargs=NETWORK, seed=0, **replay, **learning)
    model.learn(args.steps)
    returns, _ = evaluate_policy(model, env, args.episodes, return_episode_rewards=True)
    print(f"success rate {sum(total > 0.0 for total in returns) / len(returns):.2f}")


if __name__ == "__main__":
    main()
