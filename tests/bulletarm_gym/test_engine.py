"""Output of the physics engine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

MAKE = "import bulletarm_gym, gymnasium; gymnasium.make('BulletArm/CloseLoopBlockReaching-v0')"
# A release of PyBullet may print by Python, past it, and into the buffer of C's standard output.
TALKATIVE = """
import ctypes, os, sys
os.write(2, b"pybullet build time: today\\nno GPU\\n")
ctypes.CDLL(None).printf(b"pybullet build time: yesterday\\n")
print("a licence expires", file=sys.stderr)
"""


def _run(code: str, *folders: Path) -> tuple[str, str]:
    path = os.pathsep.join([*map(str, folders), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return result.stdout, result.stderr


def test_making_an_environment_prints_nothing() -> None:
    assert _run(MAKE) == ("", "")
    _run("import os; os.close(1); os.close(2); " + MAKE)


@pytest.mark.skipif(os.name != "posix", reason="C's own library prints")
def test_only_the_line_about_the_build_is_suppressed(tmp_path: Path) -> None:
    (tmp_path / "pybullet.py").write_text(TALKATIVE, encoding="utf-8")
    printed = _run("print('before'); import bulletarm_gym.simulation; print('after')", tmp_path)
    assert printed == ("before\nafter\n", "no GPU\na licence expires\n")
