#!/usr/bin/env bash
# TorchRL 0.14.1 and Minari 0.5.4: MinariExperienceReplay of a local dataset holds zeros only.
# After it has read the episodes, memmap_like() allocates new storage and does not copy them. No error and no warning.
# Seen: rewards [1, 2, 3] in Minari, [0, 0, 0] in TorchRL; observations, actions and done are zeros too.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export RL_LOGGING_LEVEL=ERROR
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    torch==2.13.0 torchrl==0.14.1 "minari[hdf5,create]==0.5.4" gymnasium==1.4.0 numpy==2.4.6 pillow==11.3.0
cat > "$folder/check.py" <<'PYTHON'
import sys

import gymnasium
import minari
import numpy as np
from torchrl.data.datasets import MinariExperienceReplay


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.array([self.time], np.float32), {}

    def step(self, action):
        self.time += 1
        return np.array([self.time], np.float32), float(self.time), self.time == 3, False, {}


env = minari.DataCollector(Env())
for _ in range(2):
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.ones(1, np.float32))
recorded = env.create_dataset("three-steps-v0")[0].rewards.tolist()
replay = MinariExperienceReplay("three-steps-v0", 3, root=sys.argv[1], load_from_local_minari=True)[:3]
rewards = replay["next", "reward"].flatten().tolist()
print("Minari", recorded, "TorchRL", rewards)
assert recorded == [1.0, 2.0, 3.0] and rewards == [0.0, 0.0, 0.0]
assert not replay["next", "observation"].any() and not replay["action"].any()
assert not replay["next", "done"].any()
PYTHON
MINARI_DATASETS_PATH="$folder/minari" "$folder/venv/bin/python" "$folder/check.py" "$folder/torchrl" 2> "$folder/log" ||
    { cat "$folder/log"; exit 1; }
