#!/usr/bin/env bash
# RLlib 2.60.0: evaluation counts the first episodes that end, so that short episodes are counted more often.
# With several environments in one runner, an evaluation stops as soon as evaluation_duration episodes have ended. The
# unfinished episodes are dropped. Half of the episodes here fail after 1 step, half succeed after 20 steps.
# Seen: mean return 0.13 with 8 environments, 0.49 with 1 (50 evaluations of 8 episodes each; 0.5 is right).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    "ray[rllib]==2.60.0" torch==2.13.0 gymnasium==1.2.2 numpy==2.4.6
cat > "$folder/check.py" <<'PYTHON'
import gymnasium
import numpy as np
import ray
from ray.rllib.algorithms.ppo import PPOConfig

random = np.random.default_rng(0)


class Env(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0.0, 9.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, config=None):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.succeeds = 0, random.random() < 0.5
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        ends = self.time == (20 if self.succeeds else 1)
        return np.zeros(1, np.float32), float(ends and self.succeeds), ends, False, {}


ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
means = {}
for number in (8, 1):
    config = PPOConfig().environment(Env).env_runners(num_env_runners=0)
    config.evaluation(
        evaluation_duration=8,
        evaluation_interval=1,
        evaluation_num_env_runners=0,
        evaluation_config={"num_envs_per_env_runner": number},
    )
    algorithm = config.build_algo()
    returns = [algorithm.evaluate()["env_runners"]["episode_return_mean"] for _ in range(50)]
    means[number] = float(np.mean(returns))
    algorithm.stop()
print({number: round(mean, 2) for number, mean in means.items()})
assert means[8] < 0.3 and means[1] > 0.4
PYTHON
"$folder/venv/bin/python" "$folder/check.py" 2> "$folder/log" || { cat "$folder/log"; exit 1; }
