#!/usr/bin/env bash
# Gymnasium 1.4.0: make(id, max_episode_steps=-1) leaves no trace for an id that is registered without a limit.
# Neither the wrappers nor env.spec differ from those of make(id). An environment that has a limit of its own
# cannot learn that the limit is to be removed, except from the call stack. Seen: equal specs and wrappers.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check gymnasium==1.4.0 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import gymnasium


class Empty(gymnasium.Env):
    observation_space = action_space = gymnasium.spaces.Discrete(2)


gymnasium.register("Empty-v0", Empty)
default = gymnasium.make("Empty-v0")
unlimited = gymnasium.make("Empty-v0", max_episode_steps=-1)
print(default.spec == unlimited.spec, str(default), str(unlimited))
assert default.spec == unlimited.spec and str(default) == str(unlimited)
PYTHON
