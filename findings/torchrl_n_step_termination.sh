#!/usr/bin/env bash
# TorchRL 0.14.1: MultiStepTransform forgets the termination of windows that reach the end of an episode.
# Rewards and next observations are those of the window's end, but done and terminated stay those of its first step.
# A target then adds the value of the terminal observation. With done_keys=[] the keys are those of the window's end.
# Seen for an episode of 4 steps and n_steps=3: next observations 3, 4, 4, 4; terminated 0, 0, 0, 1 instead of 0, 1, 1, 1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
export RL_LOGGING_LEVEL=ERROR
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check torch==2.13.0 torchrl==0.14.1 numpy==2.4.6
"$folder/venv/bin/python" - 2> "$folder/log" <<'PYTHON' || { cat "$folder/log"; exit 1; }
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import MultiStepTransform

ends = torch.tensor([False, False, False, True]).repeat(2)[:, None]  # two episodes of four steps
times = torch.arange(4.0).repeat(2)[:, None]
following = TensorDict(
    observation=times + 1, reward=ends.float(), done=ends, terminated=ends, truncated=ends & False, batch_size=8
)
steps = TensorDict(observation=times, next=following, batch_size=8)
terminated = {}
for name, arguments in {"default": {}, "done_keys=[]": {"done_keys": []}}.items():
    transform = MultiStepTransform(n_steps=3, gamma=0.9, **arguments)
    buffer = ReplayBuffer(storage=LazyTensorStorage(8), transform=transform)
    buffer.extend(steps)
    episode = buffer[:4]["next"]
    terminated[name] = episode["terminated"].flatten().int().tolist()
    print(name, "next", episode["observation"].flatten().tolist(), "terminated", terminated[name])
assert terminated == {"default": [0, 0, 0, 1], "done_keys=[]": [0, 1, 1, 1]}
PYTHON
