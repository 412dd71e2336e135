"""``python -m bulletarm_gym.play`` in a window on a virtual display, with keys from xdotool."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bulletarm_gym import demonstrations

ROOT = Path(__file__).parents[2]
TIMEOUT = 120.0
"""Maximum time (s) for a change of the window on a busy machine."""
HEADER = 4096
"""Maximum size (bytes) of the header of a screen's file, which may contain the time."""


def wait_for(condition: Callable[[], object], description: str) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end, f"{description}: not within {TIMEOUT:.0f} s"
        time.sleep(0.2)


@pytest.mark.slow
@pytest.mark.skipif(not all(map(shutil.which, ("Xvfb", "xdotool"))), reason="needs Xvfb and xdotool")
def test_keys_of_the_window_move_the_gripper_and_success_is_recorded(tmp_path: Path) -> None:
    read_end, write_end = os.pipe()
    options = ["-displayfd", str(write_end), "-screen", "0", "1100x800x24", "-fbdir", str(tmp_path)]
    server = subprocess.Popen(["Xvfb", *options], pass_fds=[write_end], stderr=subprocess.DEVNULL)
    os.close(write_end)
    with os.fdopen(read_end) as number:
        environment = {**os.environ, "DISPLAY": f":{number.readline().strip()}", "PYTHONPATH": str(ROOT)}
    env_id = "BulletArm/CloseLoopBlockPicking-v0"
    command = [sys.executable, "-m", "bulletarm_gym.play", env_id, "--record", "own.h5"]
    log = tmp_path / "output.txt"
    with log.open("w") as stream:
        game = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=stream, stderr=stream)

    def xdotool(*arguments: str) -> str:
        found = subprocess.run(["xdotool", *arguments], env=environment, check=True, capture_output=True)
        return found.stdout.decode().strip()

    def pixels() -> np.ndarray:
        return np.frombuffer((tmp_path / "Xvfb_screen0").read_bytes(), np.uint8)[HEADER:]

    try:
        wait_for(lambda: "step 0: begins" in log.read_text(), "a game")
        xdotool("windowfocus", xdotool("search", "--onlyvisible", "--name", "Bullet Physics"))
        before = pixels()
        for step, key in enumerate("sd" + "x" * 40, 1):
            xdotool("key", key)
            wait_for(lambda step=step: f"step {step}:" in log.read_text(), f"step {step}")
            if "success" in log.read_text():
                break
        wait_for(lambda: (pixels() != before).sum() >= 1000, "a change of the image")
        xdotool("key", "period")
        assert game.wait(TIMEOUT) == 0
    finally:
        for process in (game, server):
            process.kill()
            process.wait()
    (episode,) = demonstrations.load(tmp_path / "own.h5")
    np.testing.assert_allclose(episode.actions[:2, 1:], [[0.4, 0, 0, 0], [0, 0.4, 0, 0]], atol=1e-6)
