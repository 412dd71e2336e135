#!/usr/bin/env bash
# Stable-Baselines3 2.9.2: SAC.load(path, ent_coef=X) does not change the entropy coefficient. Keyword arguments of load()
# replace the saved ones, such as gamma, and model.ent_coef shows X. But train() uses model.ent_coef_tensor, which load()
# restores from the file. A training that continues with another coefficient has the old one, without a warning.
# Workaround: model.ent_coef_tensor = torch.tensor(X, device=model.device) after load().
# Seen: a model saved with 0.5 and loaded with 0.1 logs train/ent_coef 0.5, with the workaround 0.1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    stable_baselines3==2.9.2 gymnasium==1.4.0 torch==2.13.0 numpy==2.4.6
cd "$folder"
cat > load.py <<'PYTHON'
import torch
from stable_baselines3 import SAC


def logged_coefficient(model):
    """Return the coefficient that train() uses, from its log."""
    model.learn(8, log_interval=None)
    return round(model.logger.name_to_value["train/ent_coef"], 6)


settings = {"learning_starts": 4, "batch_size": 4, "buffer_size": 100, "seed": 0, "device": "cpu"}
SAC("MlpPolicy", "Pendulum-v1", ent_coef=0.5, **settings).save("model")

model = SAC.load("model", device="cpu", ent_coef=0.1, gamma=0.9)
model.set_env(SAC("MlpPolicy", "Pendulum-v1", **settings).get_env())
assert model.gamma == 0.9 and model.ent_coef == 0.1
kept = logged_coefficient(model)

model.ent_coef_tensor = torch.tensor(0.1)
replaced = logged_coefficient(model)
print(f"train/ent_coef after load(ent_coef=0.1): {kept}; with the workaround: {replaced}")
assert (kept, replaced) == (0.5, 0.1)
PYTHON
venv/bin/python load.py
