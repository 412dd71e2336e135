"""RL Baselines3 Zoo: training and evaluation of a learner of this package."""

import sys
from pathlib import Path

import numpy as np
from rl_zoo3.train import train
from rl_zoo3.utils import ALGOS

import bulletarm_gym  # noqa: F401 (registers the environments)
from sb3_extensions.sacfd import SACfD

ENV = "BulletArm/CloseLoopBlockReaching-v0"
HYPERPARAMETERS = """
BulletArm/CloseLoopBlockReaching-v0:
  n_timesteps: 40
  policy: StatePolicy
  expert_episodes: 5
  policy_kwargs: {net_arch: [32]}
"""

ALGOS["sacfd"] = SACfD
Path("sacfd.yml").write_text(HYPERPARAMETERS, encoding="utf-8")
flags = f"--algo sacfd --env {ENV} -conf sacfd.yml -f logs --seed 0 --eval-freq 20 --eval-episodes 2"
# env_kwargs of the file would not change the environment of the evaluation.
sys.argv = ["train", *flags.split(), "--env-kwargs", "observation:'state'", "max_steps:10"]
train()
(folder,) = Path("logs/sacfd").glob("BulletArm-*")
print("mean returns", np.load(folder / "evaluations.npz")["results"].mean(axis=1))
