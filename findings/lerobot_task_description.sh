#!/usr/bin/env bash
# Gymnasium 1.2.2 and LeRobot 0.4.4: LeRobot's evaluation looks for the task of an environment with
# hasattr(env.envs[0], "task_description"). gymnasium.make() returns a wrapper, and since Gymnasium 1.0 wrappers do not pass
# attributes on, so an attribute of the environment itself is not found. The policy gets "" as its instruction, without a word.
# An attribute set on the outermost wrapper is found. Seen: [''] and then ['pick up the cube'].
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check gymnasium==1.2.2 numpy==2.2.6
"$folder/venv/bin/python" -m pip download --quiet --disable-pip-version-check --no-deps --dest "$folder" lerobot==0.4.4
(cd "$folder" && "$folder/venv/bin/python" -m zipfile -e lerobot-0.4.4-*.whl lerobot_files)
"$folder/venv/bin/python" - "$folder/lerobot_files/lerobot/envs/utils.py" <<'PYTHON'
import ast
import pathlib
import sys

import gymnasium
from gymnasium import spaces

# The function alone: the modules that LeRobot imports with it are several gigabytes.
tree = ast.parse(pathlib.Path(sys.argv[1]).read_text())
(function,) = [node for node in tree.body if getattr(node, "name", "") == "add_envs_task"]
function.returns = None
for argument in function.args.args:
    argument.annotation = None
scope = {}
exec(compile(ast.Module([function], []), sys.argv[1], "exec"), scope)


class Env(gymnasium.Env):
    observation_space = action_space = spaces.Box(-1.0, 1.0, (1,))
    task_description = "pick up the cube"

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}


gymnasium.register("Findings/Task-v0", entry_point=Env)
envs = gymnasium.make_vec("Findings/Task-v0", num_envs=1, vectorization_mode="sync")
observation = {"state": envs.reset(seed=0)[0]}
without = scope["add_envs_task"](envs, dict(observation))["task"]
envs.envs[0].task_description = "pick up the cube"
with_attribute = scope["add_envs_task"](envs, dict(observation))["task"]
print(without, "then", with_attribute)
assert without == [""] and with_attribute == ["pick up the cube"]
PYTHON
