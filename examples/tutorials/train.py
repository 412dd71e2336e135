"""Tutorial 2: train an equivariant agent from demonstrations, save it, load it, evaluate it."""

import sys

import gymnasium
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.sacfd import SACfD

ENV_ID = "BulletArm/CloseLoopBlockReaching-v0"
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 500  # also the number of updates before the first step

model = SACfD(
    "EquivariantPolicy",
    gymnasium.make(ENV_ID, obs_size=64),
    expert_episodes=max(2, STEPS // 10),
    pretrain_steps=STEPS,
    buffer_size=5_000,
    batch_size=32,
    policy_kwargs={"features_extractor_kwargs": {"n": 4, "channels": [4, 8, 16, 32, 32]}},
    seed=0,
)
model.learn(STEPS)
model.save("reaching")

# Episodes with other seeds than in the training. The return is 1 for success.
env = make_vec_env(ENV_ID, 1, seed=1_000, env_kwargs={"obs_size": 64})
episodes = min(20, STEPS)
success, _ = evaluate_policy(SACfD.load("reaching"), env, episodes)
print(f"success rate {success:.2f} in {episodes} episodes")
