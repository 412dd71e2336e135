#!/usr/bin/env bash
# SuperSuit 3.11.0: sticky_actions_v0 repeats only the first episode after reset(seed=).
# Each reset() without a seed makes a new generator from the operating system's entropy. Gymnasium and Stable-Baselines3 pass a
# seed to the first reset only, so two runs with the same seed differ from the second episode on. Gymnasium's StickyAction uses
# the generator of the environment and repeats all episodes.
# Seen for CartPole with fixed actions and 5 episodes: equal episodes of two runs with seed 0: the first with
# SuperSuit, all 5 with StickyAction.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check supersuit==3.11.0 pettingzoo==1.27.0 gymnasium==1.4.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import gymnasium
import numpy as np
import supersuit
from gymnasium.wrappers import StickyAction


def run(wrap):
    env, episodes = wrap(gymnasium.make("CartPole-v1")), []
    for number in range(5):
        state, _ = env.reset(seed=0 if number == 0 else None)
        states, ends = [state], False
        while not ends:
            state, _, terminated, truncated, _ = env.step(len(states) % 2)
            states.append(state)
            ends = terminated or truncated
        episodes.append(np.array(states))
    return episodes


equal = {}
for name, wrap in (
    ("SuperSuit", lambda env: supersuit.sticky_actions_v0(env, 0.5)),
    ("Gymnasium", lambda env: StickyAction(env, 0.5)),
):
    equal[name] = [np.array_equal(first, second) for first, second in zip(run(wrap), run(wrap), strict=True)]
    print(name, "equal episodes of two runs with seed 0:", equal[name])
assert equal["SuperSuit"][0] and not all(equal["SuperSuit"][1:]) and all(equal["Gymnasium"])
PYTHON
