#!/usr/bin/env bash
# Gymnasium 1.4.0: AsyncVectorEnv(shared_memory=False) resets a member a second time after an explicit reset().
# If an episode has ended, reset() leaves the worker's autoreset flag set, and the next step() resets again.
# A state passed by reset(options=...) is lost without an error. Seen: 2 resets instead of 1 (shared memory: 1).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check gymnasium==1.4.0 numpy==2.2.6
cat > "$folder/check.py" <<'PYTHON'
import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv


class Counting(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 99.0, (1,))
    action_space = gymnasium.spaces.Discrete(2)
    resets = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets += 1
        return np.array([self.resets], np.float32), {}

    def step(self, action):
        return np.array([self.resets], np.float32), 0.0, bool(action), False, {}


if __name__ == "__main__":
    resets = {}
    for shared in (True, False):
        envs = AsyncVectorEnv([Counting], shared_memory=shared)
        envs.reset()
        envs.step(np.array([1]))  # the episode ends
        first = envs.reset()[0].item()
        resets[shared] = envs.step(np.array([0]))[0].item() - first
        envs.close()
    print("further resets by step():", resets)
    assert resets == {True: 0.0, False: 1.0}, resets
PYTHON
"$folder/venv/bin/python" "$folder/check.py"
