"""Play an environment: move its gripper with keys, or let the expert act.

Press the keys in the window. Without a display, or with --no-window, the program reads keys as letters from
the standard input, and writes an image after each key.
"""

import argparse
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

import bulletarm_gym  # noqa: F401 (registers the environments)
from bulletarm_gym.command_line import add_environment_arguments, integer_from, make_env, reported_errors
from bulletarm_gym.config import OPEN_LOOP
from bulletarm_gym.demonstrations import RecordDemonstrations
from bulletarm_gym.env import Action, ManipulationEnv
from bulletarm_gym.simulation import has_display

BINDINGS = {
    "sw": ("x", 0),
    "da": ("y", 0),
    "rf": ("z", 0),
    "qe": ("r", 0),
    "ik": ("r", 1),
    "jl": ("r", 2),
}
"""Character of the action sequence, and its number among equal characters, that two keys raise and lower."""
GRIPPER = "g"
"""Key that closes or opens the gripper; with an open-loop control it picks or places."""
STEP = 0.4
"""Size of a closed-loop action: 2 cm or 18 degrees."""
STRIDE = {"x": 0.05, "y": 0.05, "z": 0.05, "r": 0.25}
"""Motion of an open-loop target as a fraction of half a range: 1 cm of a workspace of 0.4 m, 22.5 degrees."""
START_Z = -0.8
"""Initial height of an open-loop target: 3 cm above the floor."""


class Teleoperation:
    """Conversion of keys to actions.

    With a closed-loop control each key is a step, and the gripper keeps its opening. With an open-loop
    control keys move a target, and :data:`GRIPPER` picks or places at the target.
    """

    def __init__(self, env: ManipulationEnv) -> None:
        self._env = env
        self._sequence = env.config.action_sequence
        self._is_primitive = np.array([name == "p" for name in self._sequence])
        self.has_target = env.config.control == OPEN_LOOP
        self._keys: dict[str, tuple[int, float]] = {}
        for keys, (character, number) in BINDINGS.items():
            indices = [index for index, name in enumerate(self._sequence) if name == character]
            if number < len(indices):
                self._keys |= {keys[0]: (indices[number], 1.0), keys[1]: (indices[number], -1.0)}
        self.reset()

    def reset(self) -> None:
        """Begin an episode with an open gripper, or with the target in the middle."""
        start = {"z": START_Z} if self.has_target else {"p": 1.0}
        self._last = np.array([start.get(name, 0.0) for name in self._sequence], np.float32)

    def accepts(self, key: str) -> bool:
        """Return True if a key has a function in this environment."""
        return key == GRIPPER or key in self._keys

    def press(self, key: str) -> Action | None:
        """Return the action of an accepted key, or None if the key moves the target."""
        if self.has_target and key == GRIPPER:
            return self.target()
        index, direction = self._keys.get(key, (0, 0.0))
        if self.has_target:
            stride = STRIDE[self._sequence[index]]
            self._last[index] = np.clip(self._last[index] + stride * direction, -1.0, 1.0)
            return None
        opening = 1.0 if (self._last[self._is_primitive] > 0.0).any() else -1.0
        action = np.zeros(len(self._sequence), np.float32)
        action[index] = STEP * direction
        action[self._is_primitive] = -opening if key == GRIPPER else opening
        self.follow(action)
        return action

    def follow(self, action: Action) -> None:
        """Continue from the opening or the target of an action."""
        self._last = np.array(action, np.float32)

    def target(self) -> Action:
        """Return the pick at the target, or the place if the gripper holds an object."""
        is_holding = self._env.scene.held is not None
        return np.where(self._is_primitive, np.float32(1.0 if is_holding else -1.0), self._last)

    def pixel(self, size: int) -> tuple[int, int]:
        """Return row and column of the target in a heightmap with ``size`` pixels per side."""
        x, y = (float(self._last[self._sequence.index(axis)]) for axis in "xy")
        return min(int((x + 1.0) / 2.0 * size), size - 1), min(int((y + 1.0) / 2.0 * size), size - 1)


EXPERT, NEW_EPISODE, QUIT = "xn."
"""Keys that are not part of an action."""
HELP = """keys:
  w s  along x      a d  along y      r f  up and down
  q e  yaw          i k, j l  tilt    g    close or open; with an open-loop control pick or place
  x    step of the expert             n    new episode     .    quit"""
PIXELS = 320
"""Side length of an image of the scene."""
RADIUS = 7
"""Radius (pixels) of the mark of an open-loop target."""


def main(argv: Sequence[str] | None = None) -> int:
    """Play, and return the exit status."""
    parser = argparse.ArgumentParser(
        "python -m bulletarm_gym.play",
        description=__doc__,
        epilog=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("env", metavar="ID", help="id of the environment")
    add("--record", type=Path, metavar="FILE", help="file of demonstrations; successful episodes are added")
    add("-n", "--episodes", type=integer_from(1), help="number of episodes (no limit)")
    add("--no-window", action="store_true", help="read letters and write images, even if there is a display")
    add("-f", "--folder", type=Path, default=Path("play"), help="folder of the images (play)")
    add_environment_arguments(parser)
    args = parser.parse_args(argv)
    mode = "rgb_array" if args.no_window or not has_display() else "human"
    with reported_errors(parser):
        env = make_env(args.env, args, render_mode=mode)
        if args.record:
            env = RecordDemonstrations(env, args.record)
    print(f"{args.env}\n{HELP}", flush=True)
    with closing(env):
        Game(env, args.folder, args.seed).play(args.episodes)
    if isinstance(env, RecordDemonstrations):
        print(f"{len(env)} episodes in {args.record}")
    return 0


class Game:
    """Episodes that a person plays, by keys of the window, or by letters with images in a folder."""

    def __init__(self, env: gymnasium.Env[Any, Any], folder: Path, seed: int) -> None:
        self.env, self.folder, self.seed = env, folder, seed
        self.core: ManipulationEnv = env.unwrapped  # type: ignore[assignment]
        self.has_window = env.render_mode == "human"
        self.teleoperation = Teleoperation(self.core)
        self.episode = 0

    def play(self, episodes: int | None = None) -> None:
        """Play until the last episode, the quit key or the end of the keys."""
        self._begin()
        letters = (key for line in sys.stdin for key in "".join(line.split()))
        for key in self._window_keys() if self.has_window else letters:
            if key == QUIT:
                return
            if key == NEW_EPISODE or self._act(key):
                if self.episode == episodes:
                    return
                self._begin()

    def _begin(self) -> None:
        self.observation, _ = self.env.reset(seed=self.seed + self.episode)
        self.episode, self.step, self.images = self.episode + 1, 0, 0
        self.teleoperation.reset()
        self._show("begins")

    def _act(self, key: str) -> bool:
        """Carry out a key, and return True if the episode is over."""
        if key != EXPERT and not self.teleoperation.accepts(key):
            print(f"{key!r} has no function in this environment\n{HELP}", flush=True)
            return False
        action = self.core.expert_action() if key == EXPERT else self.teleoperation.press(key)
        if action is None:
            self._show("target moved")
            return False
        self.teleoperation.follow(action)
        self.observation, _, terminated, truncated, info = self.env.step(action)
        self.step += 1
        is_over = terminated or truncated
        if is_over:
            self._show("success" if info["is_success"] else "failure")
        else:
            holding = self.core.scene.held is not None
            self._show("holding an object" if holding else "ignored" if info["ignored"] else "done")
        return is_over

    def _show(self, event: str) -> None:
        """Print an event; mark the target in the window, or write an image."""
        message = f"episode {self.episode}, step {self.step}: {event}"
        if not self.has_window:
            path = self.folder / f"episode_{self.episode:02d}" / f"{self.images:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._image().save(path)
            self.images += 1
            message += f"  {path}"
        elif self.teleoperation.has_target:
            target: Any = self.core.decode_action(self.teleoperation.target())
            self.core.viewer.mark(target.position, target.rotation[0])
        print(message, flush=True)

    def _image(self) -> Image.Image:
        """Return an image of the scene, with the heightmap and the target in it if there are any."""
        scene = self.core.viewer.close_up(PIXELS)
        if "heightmap" not in self.observation:
            return Image.fromarray(scene)
        heights = self.observation["heightmap"][0]
        gray = np.uint8(255 * heights / max(heights.max(), 1e-6))
        panel = Image.fromarray(gray).resize((PIXELS, PIXELS), Image.Resampling.NEAREST).convert("RGB")
        if self.teleoperation.has_target:  # a circle, and a line in which the fingers open
            target: Any = self.core.decode_action(self.teleoperation.target())
            (y, x), yaw, draw = self.teleoperation.pixel(PIXELS), target.rotation[0], ImageDraw.Draw(panel)
            down, right = 2 * RADIUS * math.cos(yaw), 2 * RADIUS * math.sin(yaw)
            draw.ellipse((x - RADIUS, y - RADIUS, x + RADIUS, y + RADIUS), outline="red", width=2)
            draw.line((x - right, y - down, x + right, y + down), fill="red", width=2)
        return Image.fromarray(np.hstack([scene, np.asarray(panel)]))

    def _window_keys(self) -> Iterator[str]:
        while True:
            try:
                yield from self.core.viewer.pressed_keys()
            except Exception as error:  # PyBullet's error after the window was closed
                print(f"the window was closed ({error})")
                return
            time.sleep(0.02)


if __name__ == "__main__":
    sys.exit(main())
