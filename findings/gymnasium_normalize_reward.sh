#!/usr/bin/env bash
# Gymnasium 1.4.0: NormalizeReward scales a sparse reward by the number of past episodes.
# The discounted sum of rewards is not set to 0 by reset(). A reward of 1 at the end of an episode stays in the sum of the next
# episode, so that the variance falls (terminated) or rises (truncated) with every episode. Stable-Baselines3 2.9.2 sets it to 0.
# Seen for episodes of 10 steps, the first and the 500th normalised reward: 3.33, 20.4 if they terminate;
# 3.33, 0.95 if they are truncated; 3.33, 3.33 with VecNormalize.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    stable-baselines3==2.9.2 torch==2.13.0 gymnasium==1.4.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import gymnasium
import numpy as np
from gymnasium.wrappers import NormalizeReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, terminates=True):
        self.terminates = terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        ends = self.time == 10
        return np.zeros(1, np.float32), float(ends), ends and self.terminates, ends and not self.terminates, {}


rewards = {}
for name, terminates in (("terminated", True), ("truncated", False)):
    env = NormalizeReward(Env(terminates))
    rewards[name] = []
    for _ in range(500):
        env.reset()
        rewards[name].append(float([env.step(np.zeros(1))[1] for _ in range(10)][-1]))
venv = VecNormalize(DummyVecEnv([Env]), norm_obs=False)
venv.reset()
rewards["VecNormalize"] = [float(venv.step(np.zeros((1, 1)))[1][0]) for _ in range(5000)][9::10]
found = {name: (round(values[0], 2), round(values[-1], 2)) for name, values in rewards.items()}
print(found)
assert found == {"terminated": (3.33, 20.4), "truncated": (3.33, 0.95), "VecNormalize": (3.33, 3.33)}
PYTHON
