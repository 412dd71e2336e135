"""Compiled code: the logged line, the cache, and compilation in make() alone."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LOOP = """
from bulletarm_gym.geometry.compilation import compiled

@compiled
def successor(x):
    return x + 1

print(successor(1), successor.stats.cache_path)
"""
EPISODES = """
import gymnasium
import bulletarm_gym
from bulletarm_gym.geometry.compilation import MONITOR

for name in NAMES:
    env = gymnasium.make(f"BulletArm/{name}-v0").unwrapped
    count = MONITOR.count
    env.reset(seed=0)
    for _ in range(6):
        *_, terminated, truncated, _ = env.step(env.expert_action())
        if terminated or truncated:
            env.reset()
    env.set_state(env.get_state())
    print(name, MONITOR.count - count)
    env.close()
"""
NAMES = [
    "CloseLoopBlockPicking",
    "OpenLoopBlockStacking",
    "OpenLoopRampHouseBuilding2",
    "CloseLoopDrawerOpening",
]
NAMES += [
    "OpenLoopBumpHouseBuilding4",
    "OpenLoopBinPacking",
    "OpenLoopObjectGrasping",
    "CloseLoopBlockSorting",
]


def run(folder: Path, code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    path = folder / "script.py"
    path.write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **variables}
    command = [sys.executable, str(path)]
    child = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert child.returncode == 0, child.stderr
    return child


def test_one_line_is_logged_while_a_function_is_compiled(tmp_path: Path) -> None:
    cache = str(tmp_path / "cache")
    first, second = (run(tmp_path, LOOP, NUMBA_CACHE_DIR=cache) for _ in range(2))
    (line,) = first.stderr.splitlines()
    assert cache in line and second.stderr == "" and second.stdout == first.stdout


@pytest.mark.slow
def test_compiled_code_is_kept_in_a_temporary_folder_without_a_writable_one(tmp_path: Path) -> None:
    (tmp_path / "__pycache__").touch()  # in place of the folder, which root could write
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/cache", "NUMBA_CACHE_DIR": ""}
    first, second = (run(tmp_path, LOOP, TMPDIR=str(temporary), **nowhere) for _ in range(2))
    advice, _ = first.stderr.splitlines()
    assert "NUMBA_CACHE_DIR" in advice and str(temporary) in advice and str(temporary) in first.stdout
    assert second.stderr.splitlines() == [advice], "the second process reads the compiled code"


@pytest.mark.slow
def test_only_make_compiles(tmp_path: Path) -> None:
    answer = run(tmp_path, EPISODES.replace("NAMES", repr(NAMES)), NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    counts = dict(line.split() for line in answer.stdout.splitlines())
    assert counts == dict.fromkeys(NAMES, "0") and len(answer.stderr.splitlines()) == 1, answer.stderr
