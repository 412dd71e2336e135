#!/usr/bin/env bash
# Stable-Baselines3 2.9.2: a saved model keeps its action noise for the number of environments of its training.
# load() accepts another number of environments, and without action noise the training continues. With it, learn() fails,
# because a VectorizedActionNoise of the former number is in the file and is used again.
# Workaround: model.action_noise = model.action_noise.base_noise before learn().
# Seen with a training in 2 environments that continues in 1 and in 3: ValueError with the noise, no error without it or
# with the workaround.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    stable_baselines3==2.9.2 gymnasium==1.4.0 torch==2.13.0 numpy==2.4.6
cd "$folder"
cat > resume.py <<'PYTHON'
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise


def continues(noise, n_envs, workaround=False):
    """Return whether a training in two environments continues in another number of them."""
    settings = {"learning_starts": 4, "batch_size": 4, "buffer_size": 100, "seed": 0, "device": "cpu"}
    model = SAC("MlpPolicy", make_vec_env("Pendulum-v1", n_envs=2), action_noise=noise, **settings)
    model.learn(8)
    model.save("model")
    model = SAC.load("model", env=make_vec_env("Pendulum-v1", n_envs=n_envs), device="cpu")
    if workaround:
        model.action_noise = model.action_noise.base_noise
    try:
        model.learn(9)
    except ValueError as error:
        print(f"{n_envs} environments: {error}")
        return False
    return True


noise = NormalActionNoise(mean=np.zeros(1), sigma=0.1 * np.ones(1))
for n_envs in (1, 3):
    assert continues(None, n_envs)
    assert not continues(noise, n_envs)
    assert continues(noise, n_envs, workaround=True)
PYTHON
venv/bin/python resume.py
