#!/usr/bin/env bash
# AgileRL 2.58.0: generalised advantage estimation of RolloutBuffer separates episodes one step too early.
# collect_rollouts() stores with each step whether that step ended its episode. compute_returns_and_advantages() reads the flag of
# the next step instead, so the reward of the last step does not reach the earlier steps of the episode, and the value of the next
# episode does. The Monte Carlo returns of the same class (use_gae=False) read the flag of the step itself.
# Seen for two episodes of 2 steps with reward 1 at their ends (no discount, all values 0): 0, 1, 0, 1 instead of 1, 1, 1, 1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check agilerl==2.58.0 torch==2.13.0
"$folder/venv/bin/python" - 2> "$folder/log" <<'PYTHON' || { cat "$folder/log"; exit 1; }
import gymnasium
import numpy as np
from agilerl.components.rollout_buffer import RolloutBuffer

space, returns = gymnasium.spaces.Box(-1.0, 1.0, (1,)), {}
for use_gae in (True, False):
    buffer = RolloutBuffer(4, space, space, gamma=1.0, gae_lambda=1.0, use_gae=use_gae)
    for step in range(4):
        end, zero = np.array([step % 2 == 1]), np.zeros(1, np.float32)
        buffer.add(zero[None], zero[None], reward=end.astype(np.float32), done=end, value=zero, log_prob=zero)
    buffer.compute_returns_and_advantages(last_value=np.zeros(1), last_done=np.ones(1))
    returns["GAE" if use_gae else "Monte Carlo"] = buffer.buffer["returns"].flatten().tolist()
print(returns)
assert returns == {"GAE": [0.0, 1.0, 0.0, 1.0], "Monte Carlo": [1.0, 1.0, 1.0, 1.0]}
PYTHON
