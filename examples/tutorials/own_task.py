"""Tutorial 3: check the task of my_tasks.py, and collect demonstrations of its expert."""

import gymnasium
import my_tasks
import numpy as np
from gymnasium.utils.env_checker import check_env

from bulletarm_gym.demonstrations import collect

ENV_ID = "BulletArm/CloseLoopBlockCentring-v0"

env = gymnasium.make(ENV_ID, obs_size=64)
check_env(env.unwrapped, skip_render_check=True)
print(my_tasks.BlockCentring.__name__, "passes Gymnasium's check_env")

found = collect(ENV_ID, 5, seed=0, env_kwargs={"obs_size": 64})
print(f"{len(found)} of {found.attempts} attempts, {np.mean([len(episode) for episode in found]):.1f} steps")
