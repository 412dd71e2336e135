"""Compiled code: what is said while it is made, where it is kept, and that make() alone waits for it."""

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

for name in (
    "CloseLoopBlockPicking",
    "OpenLoopBlockStacking",
    "OpenLoopRampHouseBuilding2",
    "OpenLoopBumpHouseBuilding4",
    "CloseLoopDrawerOpening",
    "OpenLoopBinPacking",
    "OpenLoopObjectGrasping",
    "CloseLoopBlockSorting",
):
    env = gymnasium.make(f"BulletArm/{name}-v0").unwrapped
    count = MONITOR.count
    env.reset(seed=0)
    for _ in range(6):
        *_, terminated, truncated, _ = env.step(env.expert_action())
        if terminated or truncated:
            env.reset()
    state = env.get_state()
    env.set_state(state)
    print(name, MONITOR.count - count)
    env.close()
"""


def run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **variables}
    child = subprocess.run(
        [sys.executable, code], capture_output=True, text=True, check=False, env=environment
    )
    assert child.returncode == 0, child.stderr
    return child


def script(folder: Path, text: str) -> str:
    path = folder / "script.py"
    path.write_text(text)
    return str(path)


def test_one_line_is_logged_while_a_function_is_compiled(tmp_path: Path) -> None:
    code, cache = script(tmp_path, LOOP), str(tmp_path / "cache")
    first, second = (run(code, NUMBA_CACHE_DIR=cache) for _ in range(2))
    (line,) = first.stderr.splitlines()
    assert "compiles" in line and cache in line
    assert second.stderr == "" and second.stdout == first.stdout


def test_compiled_code_is_kept_in_a_temporary_folder_without_a_writable_one(tmp_path: Path) -> None:
    (tmp_path / "__pycache__").touch()  # in place of the folder, which root could write
    (tmp_path / "temporary").mkdir()
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/cache", "NUMBA_CACHE_DIR": ""}
    code = script(tmp_path, LOOP)
    first, second = (run(code, TMPDIR=str(tmp_path / "temporary"), **nowhere) for _ in range(2))
    said, compiles = first.stderr.splitlines()
    assert "NUMBA_CACHE_DIR" in said and str(tmp_path / "temporary") in said and "compiles" in compiles
    assert str(tmp_path / "temporary") in first.stdout
    assert len(second.stderr.splitlines()) == 1, "the second process reads what the first has compiled"


@pytest.mark.slow
def test_make_alone_compiles(tmp_path: Path) -> None:
    answer = run(script(tmp_path, EPISODES), NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    counts = dict(line.split() for line in answer.stdout.splitlines())
    assert len(counts) == 8 and set(counts.values()) == {"0"}, counts
    assert len(answer.stderr.splitlines()) == 1, answer.stderr
