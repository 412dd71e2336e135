"""Train one SACfD agent with an equivariant network on three tasks: python examples/train_multi_task.py."""

import argparse

from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from bulletarm_gym.vector import make_multi_task_vec
from sb3_extensions.sacfd import SACfD

IDS = [f"BulletArm/CloseLoop{task}-v0" for task in ("BlockReaching", "BlockPicking", "BlockPushing")]


def main() -> None:
    """Train, and print the success rate of each task: the reward is 1 for success."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=30_000, help="time steps over all environments")
    parser.add_argument("--pretrain", type=int, default=2_000, help="updates on the demonstrations")
    parser.add_argument("--expert-episodes", type=int, default=150, help="demonstrations of all tasks")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of the evaluation of each task")
    args = parser.parse_args()
    vec_env = make_multi_task_vec(IDS, vec_env_cls=DummyVecEnv, obs_size=64)
    model = SACfD(
        "EquivariantPolicy",
        vec_env,
        expert_episodes=args.expert_episodes,
        pretrain_steps=args.pretrain,
        policy_kwargs={"features_extractor_kwargs": {"n": 4, "channels": [4, 8, 16, 32, 32]}},
        seed=0,
    )
    model.learn(args.steps)
    for env_id, env in zip(IDS, vec_env.envs, strict=True):
        success, _ = evaluate_policy(model, env, args.episodes, warn=False)
        print(f"{env_id}: success rate {success:.2f}")


if __name__ == "__main__":
    main()
