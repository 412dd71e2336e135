#!/usr/bin/env bash
# SuperSuit 3.11.0: the environments of gym_vec_env_v0(env, n) all play the same episodes if env was reset before.
# The copies include the state of the random generator, so episode k of each environment begins with the same state unless the
# vector environment is seeded. There is no warning, and a check such as check_env(env) is enough.
# Seen: 1 different first state of 4 CartPoles in each of 20 episodes after check_env(env), 4 without it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    supersuit==3.11.0 pettingzoo==1.27.0 gymnasium==1.4.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import gymnasium
import numpy as np
import supersuit
from gymnasium.utils.env_checker import check_env

different = {}
for checked in (False, True):
    env = gymnasium.make("CartPole-v1")
    if checked:
        check_env(env.unwrapped, skip_render_check=True)
    envs = supersuit.gym_vec_env_v0(env, 4)
    different[checked] = {len(np.unique(envs.reset()[0], axis=0)) for _ in range(20)}
    print("after check_env(env):", checked, "different first states of 4 environments:", different[checked])
assert different == {False: {4}, True: {1}}
PYTHON
