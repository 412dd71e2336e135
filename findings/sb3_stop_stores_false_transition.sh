#!/usr/bin/env bash
# Stable-Baselines3 2.9.2: learn(reset_num_timesteps=False) after a callback has stopped an off-policy training stores a false
# transition. The step at which the callback stops is executed but not stored, and the next learn() continues from the
# observation before it. The first new transition has that observation, the new action and the observation after both.
# If the stop was at the end of an episode, the transition joins two episodes, with done=False.
# Workaround: model._last_obs = None before the second learn(), which then resets the environment.
# Seen with an environment that observes its step number: (4, 6) instead of (4, 5), and (4, 1) across two episodes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    stable_baselines3==2.9.2 gymnasium==1.4.0 torch==2.13.0 numpy==2.4.6
cd "$folder"
cat > stop.py <<'PYTHON'
import gymnasium
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback


class Count(gymnasium.Env):
    """Observes the number of steps of the episode."""

    observation_space = gymnasium.spaces.Box(0.0, np.inf, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, length):
        self.length, self.steps = length, 0

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.full(1, self.steps, np.float32), 0.0, self.steps == self.length, False, {}


class Stop(BaseCallback):
    """Stops the training at the fifth step."""

    def _on_step(self):
        return self.num_timesteps < 5


def transitions(length, workaround):
    """Return (observation, next observation, done) of a training that is stopped and continued."""
    model = SAC("MlpPolicy", Count(length), buffer_size=50, learning_starts=1000, device="cpu")
    model.learn(100, callback=Stop())
    if workaround:
        model._last_obs = None
    model.learn(3, reset_num_timesteps=False)
    buffer = model.replay_buffer
    columns = buffer.observations, buffer.next_observations, buffer.dones
    return [tuple(int(column[row].item()) for column in columns) for row in range(buffer.pos)]


for length in (100, 5):
    for workaround in (False, True):
        found = transitions(length, workaround)
        print(f"episodes of {length} steps, workaround {workaround}: {found}")
        false = [(first, second) for first, second, _ in found if second != first + 1]
        assert false == ([] if workaround else [(4, 6) if length == 100 else (4, 1)])
        assert all(done == (second == length) for _, second, done in found)
PYTHON
venv/bin/python stop.py
