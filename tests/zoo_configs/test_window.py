"""``bulletarm-zoo play`` in a real window, its keys pressed by xdotool, on a display of the tests' own."""

from __future__ import annotations

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

from zoo_configs.cli import main
from zoo_configs.environments import demonstrations

TOOLS = ("Xvfb", "xdotool")
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
PATIENCE = 120.0  # s that a window may take on a busy machine
COMMAND = "import sys; from zoo_configs.cli import main; sys.exit(main())"
SCREEN = "Xvfb_screen0"
STEADY = 5  # looks that are equal
HEADER = 4096  # bytes of a screen's file that may tell the time

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        any(shutil.which(tool) is None for tool in TOOLS), reason=f"needs {' and '.join(TOOLS)}"
    ),
]


def wait_for(what: Callable[[], object], why: str) -> None:
    """Wait until something is true."""
    end = time.monotonic() + PATIENCE
    while not what():
        assert time.monotonic() < end, f"{why}: not within {PATIENCE:.0f} s"
        time.sleep(0.2)


class Player:
    """A person at a screen.

    :param folder: where the screen's pixels are, and where the game is played
    :param arguments: of the command
    """

    def __init__(self, folder: Path, display: str, *arguments: str) -> None:
        self._screen, self._log = folder / SCREEN, folder / "said.txt"
        self._environment = {**os.environ, "DISPLAY": display}
        with self._log.open("w") as log:
            self.game = subprocess.Popen(
                [sys.executable, "-c", COMMAND, "play", *arguments],
                cwd=folder,
                env=self._environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        wait_for(lambda: "step 0: begins" in self.said or self.game.poll() is not None, "a game")
        assert self.game.poll() is None, self.said
        (window,) = self._xdotool("search", "--onlyvisible", "--name", "Bullet Physics").split()
        self._xdotool("windowfocus", window)

    @property
    def said(self) -> str:
        """What the command has printed."""
        return self._log.read_text(encoding="utf-8", errors="replace")

    def press(self, *keys: str) -> None:
        """Tap keys, one after the other without waiting."""
        for key in keys:
            self._xdotool("key", key)

    def look(self) -> np.ndarray:
        """Return the bytes of the screen once they have stayed the same for a while."""
        seen = [self._pixels()]
        while len(seen) < STEADY or any((one != seen[-1]).any() for one in seen[-STEADY:]):
            assert len(seen) < 200, "the picture never stays the same"
            time.sleep(0.3)
            seen.append(self._pixels())
        return seen[-1]

    def sees_change(self, before: np.ndarray, least: int) -> None:
        """Wait until that many bytes of the screen are other ones."""
        wait_for(lambda: (self._pixels() != before).sum() >= least, "a change of the picture")

    def _pixels(self) -> np.ndarray:
        return np.frombuffer(self._screen.read_bytes(), np.uint8)[HEADER:]

    def _xdotool(self, *arguments: str) -> str:
        return subprocess.run(
            ["xdotool", *arguments], env=self._environment, check=True, capture_output=True, text=True
        ).stdout


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Callable[..., Player]]:
    """A display of one's own, and games on it."""
    ours, theirs = os.pipe()
    options = ["-displayfd", str(theirs), "-screen", "0", "1100x800x24", "-fbdir", str(tmp_path)]
    server = subprocess.Popen(
        ["Xvfb", *options], pass_fds=[theirs], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(theirs)
    with os.fdopen(ours) as number:
        display = f":{number.readline().strip()}"
    players: list[Player] = []

    def begin(*arguments: str) -> Player:
        players.append(Player(tmp_path, display, *arguments))
        return players[-1]

    yield begin
    for process in (*(player.game for player in players), server):
        process.kill()
        process.wait()


def test_keys_move_the_gripper_and_what_was_done_trains(
    play: Callable[..., Player], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    player = play(PICKING, "--record", "own.h5", "--env-kwargs", "obs_size:64")
    before = player.look()
    player.press("s")
    wait_for(lambda: "step 1\n" in player.said, "the first step")
    player.sees_change(before, 1000)
    player.press("d")
    wait_for(lambda: "step 2\n" in player.said, "the second step")
    for step in range(3, 40):
        player.press("x")
        wait_for(lambda step=step: re.search(f"step {step}[:\n]", player.said), f"step {step}")
        if "success" in player.said:
            break
    player.press("period")
    assert player.game.wait(PATIENCE) == 0
    (episode,) = demonstrations().load("own.h5")
    np.testing.assert_allclose(episode.actions[:2, 1:], [[0.4, 0, 0, 0], [0, 0.4, 0, 0]], atol=1e-6)
    options = ["--preset", "quick", "-n", "2", "--no-progress", "-f", "logs", "--eval-episodes", "1"]
    parameters = ["-params", "expert_data:'own.h5'", "pretrain_steps:2"]
    assert main(["train", "--baseline", "sacfd", "--env", PICKING, *options, *parameters]) == 0


def test_a_target_is_shown_and_picked_at(play: Callable[..., Player]) -> None:
    player = play(STACKING, "--env-kwargs", "num_objects:2", "obs_size:64")
    before = player.look()
    player.press("s", "d")
    wait_for(lambda: player.said.count("target moved") == 2, "the target")
    player.sees_change(before, 100)
    player.press("x")
    wait_for(lambda: "step 1: holding something" in player.said, "a pick")
    player.press("period")
    assert player.game.wait(PATIENCE) == 0


def test_a_window_that_is_closed_ends_the_game(play: Callable[..., Player]) -> None:
    player = play(PICKING)
    (window,) = player._xdotool("search", "--onlyvisible", "--name", "Bullet Physics").split()
    player._xdotool("windowclose", window)
    wait_for(lambda: player.game.poll() is not None, "the end")
