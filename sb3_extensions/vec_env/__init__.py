"""Environments stepped in this process and in workers beside it."""

from sb3_extensions.vec_env.split_vec_env import SplitVecEnv
from sb3_extensions.vec_env.workers import WorkerError

__all__ = ["SplitVecEnv", "WorkerError"]
