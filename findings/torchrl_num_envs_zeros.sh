#!/usr/bin/env bash
# TorchRL 0.14.1 and Gymnasium 1.4.0: GymEnv(id, num_envs=2) replaces the last observation of an episode by zeros.
# Gymnasium 1.x resets in the next step and has no "final_obs" in its infos; TorchRL fills the missing one with zeros.
# A truncated episode then bootstraps from the value of zeros. SerialEnv(2, ...) has the observation.
# Seen for an episode with the observations 1, 2, 3: [1, 2, 0] with num_envs=2, [1, 2, 3] with SerialEnv.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export RL_LOGGING_LEVEL=ERROR
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    torch==2.13.0 torchrl==0.14.1 gymnasium==1.4.0 numpy==2.4.6
cat > "$folder/check.py" <<'PYTHON'
import gymnasium
import numpy as np
from torchrl.envs import GymEnv, SerialEnv


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self):  # TorchRL tries the argument frameskip
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.array([self.time], np.float32), {}

    def step(self, action):
        self.time += 1
        return np.array([self.time], np.float32), 0.0, False, self.time == 3, {}


gymnasium.register("Findings/Three-v0", entry_point=Env)
if __name__ == "__main__":
    last = {}
    for env in (GymEnv("Findings/Three-v0", num_envs=2), SerialEnv(2, lambda: GymEnv("Findings/Three-v0"))):
        name = "SerialEnv" if isinstance(env, SerialEnv) else "num_envs=2"
        steps = env.rollout(3, break_when_any_done=False)[0]
        last[name] = steps["next", "observation"].flatten().tolist()
        assert steps["next", "done"].flatten().tolist() == [False, False, True]
        env.close()
    print(last)
    assert last == {"num_envs=2": [1.0, 2.0, 0.0], "SerialEnv": [1.0, 2.0, 3.0]}
PYTHON
"$folder/venv/bin/python" "$folder/check.py" 2> "$folder/log" || { cat "$folder/log"; exit 1; }
