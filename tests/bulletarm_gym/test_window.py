"""``python -m bulletarm_gym.play`` in a window on a virtual display, with keys from xdotool."""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bulletarm_gym import demonstrations

ROOT = Path(__file__).parents[2]
TOOLS = ("Xvfb", "xdotool")
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
TIMEOUT = 120.0
"""Maximum time (s) for a change of the window on a busy machine."""
SCREEN = "Xvfb_screen0"
EQUAL_IMAGES = 5
"""Number of equal images after which the screen is at rest."""
HEADER = 4096
"""Maximum size (bytes) of the header of a screen's file, which may contain the time."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        any(shutil.which(tool) is None for tool in TOOLS), reason=f"needs {' and '.join(TOOLS)}"
    ),
]


def wait_for(condition: Callable[[], object], description: str) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end, f"{description}: not within {TIMEOUT:.0f} s"
        time.sleep(0.2)


class Player:
    """A person at a screen.

    :param folder: folder of the screen's pixels, and working directory of the game
    :param arguments: arguments of the program
    """

    def __init__(self, folder: Path, display: str, *arguments: str) -> None:
        self._screen, self._log = folder / SCREEN, folder / "output.txt"
        self._environment = {**os.environ, "DISPLAY": display, "PYTHONPATH": str(ROOT)}
        with self._log.open("w") as log:
            self.game = subprocess.Popen(
                [sys.executable, "-m", "bulletarm_gym.play", *arguments],
                cwd=folder,
                env=self._environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        wait_for(lambda: "step 0: begins" in self.output or self.game.poll() is not None, "a game")
        assert self.game.poll() is None, self.output
        self.xdotool("windowfocus", self.window())

    @property
    def output(self) -> str:
        return self._log.read_text(encoding="utf-8", errors="replace")

    def window(self) -> str:
        (window,) = self.xdotool("search", "--onlyvisible", "--name", "Bullet Physics").split()
        return window

    def press(self, *keys: str) -> None:
        for key in keys:
            self.xdotool("key", key)

    def image_at_rest(self) -> np.ndarray:
        images = [self._pixels()]
        while len(images) < EQUAL_IMAGES or any((one != images[-1]).any() for one in images[-EQUAL_IMAGES:]):
            assert len(images) < 200, "the image never stays the same"
            time.sleep(0.3)
            images.append(self._pixels())
        return images[-1]

    def wait_for_change(self, before: np.ndarray, least: int) -> None:
        """Wait until at least ``least`` bytes of the image have changed."""
        wait_for(lambda: (self._pixels() != before).sum() >= least, "a change of the image")

    def _pixels(self) -> np.ndarray:
        return np.frombuffer(self._screen.read_bytes(), np.uint8)[HEADER:]

    def xdotool(self, *arguments: str) -> str:
        return subprocess.run(
            ["xdotool", *arguments], env=self._environment, check=True, capture_output=True, text=True
        ).stdout


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Callable[..., Player]]:
    """Start games on a virtual display of this test."""
    read_end, write_end = os.pipe()
    options = ["-displayfd", str(write_end), "-screen", "0", "1100x800x24", "-fbdir", str(tmp_path)]
    server = subprocess.Popen(
        ["Xvfb", *options], pass_fds=[write_end], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(write_end)
    with os.fdopen(read_end) as number:
        display = f":{number.readline().strip()}"
    players: list[Player] = []

    def begin(*arguments: str) -> Player:
        players.append(Player(tmp_path, display, *arguments))
        return players[-1]

    yield begin
    for process in (*(player.game for player in players), server):
        process.kill()
        process.wait()


def test_keys_of_the_window_move_the_gripper_and_success_is_recorded(
    play: Callable[..., Player], tmp_path: Path
) -> None:
    player = play(PICKING, "--record", "own.h5", "--env-kwargs", "obs_size:64")
    before = player.image_at_rest()
    player.press("s")
    wait_for(lambda: "step 1: done\n" in player.output, "the first step")
    player.wait_for_change(before, 1000)
    player.press("d")
    wait_for(lambda: "step 2: done\n" in player.output, "the second step")
    for step in range(3, 40):
        player.press("x")
        wait_for(lambda step=step: re.search(f"step {step}:", player.output), f"step {step}")
        if "success" in player.output:
            break
    player.press("period")
    assert player.game.wait(TIMEOUT) == 0
    (episode,) = demonstrations.load(tmp_path / "own.h5")
    np.testing.assert_allclose(episode.actions[:2, 1:], [[0.4, 0, 0, 0], [0, 0.4, 0, 0]], atol=1e-6)


def test_open_loop_target_is_shown_in_the_window(play: Callable[..., Player]) -> None:
    player = play(STACKING, "--env-kwargs", "num_objects:2", "obs_size:64")
    before = player.image_at_rest()
    player.press("s", "d")
    wait_for(lambda: player.output.count("target moved") == 2, "the target")
    player.wait_for_change(before, 100)
    player.press("x")
    wait_for(lambda: "step 1: holding an object" in player.output, "a pick")
    player.press("period")
    assert player.game.wait(TIMEOUT) == 0


def test_closing_the_window_ends_the_game(play: Callable[..., Player]) -> None:
    player = play(PICKING)
    player.xdotool("windowclose", player.window())
    wait_for(lambda: player.game.poll() is not None, "the end")
