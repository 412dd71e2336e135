"""What importing the physics engine prints."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

MAKE = "import bulletarm_gym, gymnasium; gymnasium.make('BulletArm/CloseLoopBlockReaching-v0')"
# What a release of PyBullet may print: by Python, past it, and into the buffer of C's standard output.
TALKATIVE = """
import ctypes, os, sys
os.write(2, b"pybullet build time: today\\nno GPU\\n")
ctypes.CDLL(None).printf(b"pybullet build time: yesterday\\n")
print("a licence expires", file=sys.stderr)
"""


def _run(code: str, *folders: Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([*map(str, folders), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )


def test_making_an_environment_prints_nothing() -> None:
    result = _run(MAKE)
    assert (result.stdout, result.stderr) == ("", "")


@pytest.mark.skipif(os.name != "posix", reason="asks C's own library to print")
def test_only_the_line_about_the_build_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "pybullet.py").write_text(TALKATIVE, encoding="utf-8")
    result = _run("print('before'); import bulletarm_gym.simulation; print('after')", tmp_path)
    assert result.stdout == "before\nafter\n"
    assert result.stderr == "no GPU\na licence expires\n"


def test_closed_streams_do_not_matter() -> None:
    _run("import os; os.close(1); os.close(2); " + MAKE)
