#!/usr/bin/env bash
# RL Baselines3 Zoo 2.9.2: env_kwargs of a hyperparameter file change the training environment only.
# The evaluation environment has the default parameters, so evaluations.npz and the choice of best_model.zip are those of
# another task. --env-kwargs on the command line changes both environments, --eval-env-kwargs that of the evaluation.
# CartPole's sutton_barto_reward replaces the reward 1 of a step by 0, and by -1 at a failure.
# Seen: mean training return -1.0 in both cases; mean evaluation return 166.7 with the file, -0.8 with the command line.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    rl_zoo3==2.9.2 stable_baselines3==2.9.2 sb3_contrib==2.9.2 gymnasium==1.4.0 torch==2.13.0 numpy==2.4.6 requests==2.34.2
cd "$folder"
cat > parameters.yml <<'YAML'
CartPole-v1:
  n_timesteps: !!float 200
  policy: MlpPolicy
  n_steps: 100
  batch_size: 50
  env_kwargs:
    sutton_barto_reward: true
YAML
grep -v -e env_kwargs -e sutton_barto parameters.yml > without.yml
common=(--algo ppo --env CartPole-v1 --seed 0 --eval-freq 100 --eval-episodes 3 --verbose 0)
venv/bin/python -m rl_zoo3.train "${common[@]}" -conf parameters.yml -f file > log 2>&1 || { cat log; exit 1; }
venv/bin/python -m rl_zoo3.train "${common[@]}" -conf without.yml -f line --env-kwargs sutton_barto_reward:True > log 2>&1 ||
    { cat log; exit 1; }
venv/bin/python - <<'PYTHON'
import numpy as np

evaluated = {}
for name in ("file", "line"):
    run = f"{name}/ppo/CartPole-v1_1"
    trained = np.loadtxt(f"{run}/0.monitor.csv", delimiter=",", skiprows=2)[:, 0]
    evaluated[name] = np.load(f"{run}/evaluations.npz")["results"]
    print(f"{name}: training {trained.mean():.1f}, evaluation {evaluated[name].mean():.1f}")
    assert (trained == -1).all()
assert (evaluated["file"] > 0).all() and (evaluated["line"] <= 0).all()
PYTHON
