"""What processes print: one line while code is compiled, in make() alone, and nothing of the engine."""

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
NAMES = """
CloseLoopBlockPicking OpenLoopBlockStacking OpenLoopRampHouseBuilding2 CloseLoopDrawerOpening
OpenLoopBumpHouseBuilding4 OpenLoopBinPacking OpenLoopObjectGrasping CloseLoopBlockSorting
""".split()


def run(folder, code, **variables):
    """Return the output and the lines of the log of a process."""
    path = folder / "script.py"
    path.write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **variables}
    command = [sys.executable, str(path)]
    child = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert child.returncode == 0, child.stderr
    return child.stdout, child.stderr.splitlines()


def test_one_line_is_logged_while_a_function_is_compiled(tmp_path):
    cache = str(tmp_path / "cache")
    _, (line,) = run(tmp_path, LOOP, NUMBA_CACHE_DIR=cache)
    assert cache in line


@pytest.mark.slow
def test_compiled_code_is_kept_in_a_temporary_folder_without_a_writable_one(tmp_path):
    (tmp_path / "__pycache__").touch()  # in place of the folder, which root could write
    (tmp_path / "temporary").mkdir()
    variables = {"TMPDIR": str(tmp_path / "temporary"), "HOME": "/dev/null", "NUMBA_CACHE_DIR": ""}
    variables["XDG_CACHE_HOME"] = "/dev/null/cache"
    (output, (advice, _)), second = (run(tmp_path, LOOP, **variables) for _ in range(2))
    assert "NUMBA_CACHE_DIR" in advice and variables["TMPDIR"] in advice and variables["TMPDIR"] in output
    assert second == (output, [advice]), "the second process reads the compiled code"


@pytest.mark.slow
def test_only_make_compiles(tmp_path):
    cache = str(tmp_path / "cache")
    output, log = run(tmp_path, EPISODES.replace("NAMES", repr(NAMES)), NUMBA_CACHE_DIR=cache)
    assert output.splitlines() == [f"{name} 0" for name in NAMES] and len(log) == 1, log


MAKE = "import bulletarm_gym, gymnasium; gymnasium.make('BulletArm/CloseLoopBlockReaching-v0')"
# A release of PyBullet may print by Python, past it, and into the buffer of C's standard output.
TALKATIVE = """
import ctypes, os, sys
os.write(2, b"pybullet build time: today\\nno GPU\\n")
ctypes.CDLL(None).printf(b"pybullet build time: yesterday\\n")
print("a licence expires", file=sys.stderr)
"""


def test_environment_is_made_without_standard_output(tmp_path):
    run(tmp_path, "import os; os.close(1); os.close(2); " + MAKE)


@pytest.mark.skipif(os.name != "posix", reason="C's own library prints")
def test_only_the_line_about_the_build_is_suppressed(tmp_path):
    (tmp_path / "pybullet.py").write_text(TALKATIVE, encoding="utf-8")
    printed = run(tmp_path, "print('before'); import bulletarm_gym.simulation; print('after')")
    assert printed == ("before\nafter\n", ["no GPU", "a licence expires"])
