#!/usr/bin/env bash
# Minari 0.5.4: the seed of an episode is stored, but EpisodeData has none. It is in the metadata of the storage.
# Seen: EpisodeData without the attribute "seed", and the metadata with "seed" 7.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    "minari[hdf5,create]==0.5.4" gymnasium==1.4.0 numpy==2.4.6 pillow==11.3.0
cat > "$folder/check.py" <<'PYTHON'
import gymnasium
import minari
import numpy as np


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, True, False, {}


env = minari.DataCollector(Env())
env.reset(seed=7)
env.step(np.ones(1, np.float32))
dataset = env.create_dataset("one-step-v0")
(metadata,) = dataset.storage.get_episode_metadata([0])
print("EpisodeData", hasattr(dataset[0], "seed"), "metadata", metadata["seed"])
assert not hasattr(dataset[0], "seed") and metadata["seed"] == 7
PYTHON
MINARI_DATASETS_PATH="$folder/minari" "$folder/venv/bin/python" "$folder/check.py" 2> "$folder/log" ||
    { cat "$folder/log"; exit 1; }
