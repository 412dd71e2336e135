#!/usr/bin/env bash
# LeRobot 0.4.4: statistics of a feature that is an array, not an image, are computed for each index of its last axis.
# A heightmap of shape (1, 48, 64) gets 64 means, one for each pixel column, and is normalised by them without a word. With the
# channels last, (48, 64, 1), it gets one mean. Seen: shapes (64,) and (1,).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check numpy==2.2.6
"$folder/venv/bin/python" -m pip download --quiet --disable-pip-version-check --no-deps --dest "$folder" lerobot==0.4.4
(cd "$folder" && "$folder/venv/bin/python" -m zipfile -e lerobot-0.4.4-*.whl lerobot_files)
"$folder/venv/bin/python" - "$folder/lerobot_files/lerobot/datasets/compute_stats.py" <<'PYTHON'
import sys
import types

import numpy as np

# The module alone: those that LeRobot imports with it are several gigabytes, and are needed for images only.
utils = types.ModuleType("lerobot.datasets.utils")
utils.load_image_as_numpy = None
for name, module in (
    ("lerobot", types.ModuleType("lerobot")),
    ("lerobot.datasets", types.ModuleType("lerobot.datasets")),
    ("lerobot.datasets.utils", utils),
):
    sys.modules[name] = module
scope = {"__name__": "compute_stats"}
exec(compile(open(sys.argv[1]).read(), sys.argv[1], "exec"), scope)

found = {}
for shape in ((1, 48, 64), (48, 64, 1)):
    data = {"observation.heightmap": np.random.default_rng(0).random((5, *shape)).astype(np.float32)}
    features = {"observation.heightmap": {"dtype": "float32", "shape": shape, "names": None}}
    statistics = scope["compute_episode_stats"](data, features)
    found[shape] = statistics["observation.heightmap"]["mean"].shape
print(found)
assert found == {(1, 48, 64): (64,), (48, 64, 1): (1,)}, found
PYTHON
