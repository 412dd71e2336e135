#!/usr/bin/env bash
# RL Baselines3 Zoo 2.9.2: importing rl_zoo3, also for its plots alone, replaces Gymnasium's TimeLimit in the whole process.
# The replacement does not truncate in a step in which the environment terminates. So a wrapper that continues after success, as
# goal-conditioned environments do, has episodes without end, which the limit ends as long as nothing imports rl_zoo3.
# Here the environment terminates from step 2 on, the wrapper continues, and the limit is 3 steps.
# Seen: truncated in step 3 without the import; not truncated in 20 steps with it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    rl_zoo3==2.9.2 stable_baselines3==2.9.2 sb3_contrib==2.9.2 gymnasium==1.4.0 torch==2.13.0 numpy==2.4.6 requests==2.34.2
cd "$folder"
cat > episode.py <<'PYTHON'
import sys

if "imported" in sys.argv:
    import rl_zoo3  # noqa: F401
import gymnasium as gym


class Goal(gym.Env):
    """Terminates while the goal is reached, from the second step on."""

    observation_space = action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return 0, {}

    def step(self, action):
        self.steps += 1
        return 0, 1.0, self.steps >= 2, False, {}


class Continue(gym.Wrapper):
    """Continues after success."""

    def step(self, action):
        observation, reward, _, truncated, info = self.env.step(action)
        return observation, reward, False, truncated, info


gym.register("Goal-v0", Goal, max_episode_steps=3)
env = Continue(gym.make("Goal-v0", disable_env_checker=True))
env.reset(seed=0)
ends = [step for step in range(1, 21) if env.step(0)[3]]
print("imported" if "imported" in sys.argv else "not imported", "truncated in the steps", ends[:1])
assert ends[:1] == ([] if "imported" in sys.argv else [3])
PYTHON
venv/bin/python episode.py
venv/bin/python episode.py imported
