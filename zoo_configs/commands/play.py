"""``bulletarm-zoo play``: a person moves the gripper, by keys."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from zoo_configs.arguments import Parser, add_env_kwargs, add_packages, seed
from zoo_configs.drawing.video import PANEL_SIZE, ValueMap, compose_frame, write_picture
from zoo_configs.environments import demonstrations, known_env_id, make_env, register_environments
from zoo_configs.errors import CommandError, refused
from zoo_configs.files import check_writable
from zoo_configs.playing import EXPERT, HELP, NEW_EPISODE, QUIT, Action, OpenLoopPilot, make_pilot

DESCRIPTION = """Move the gripper of an environment yourself: in a window where there is a display; else
letters are read from the standard input, several a line, and a picture of every step is saved. Ends at the
key for it, or with the input."""
SUFFIXES = (".h5", ".hdf5")
POLL = 0.02  # s between two looks at the window's keys
WINDOW, PICTURES = "human", "rgb_array"


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no such environment, or nothing can be recorded
    """
    args = _parse(argv)
    register_environments(args.gym_packages)
    env_id = known_env_id(args.env)
    if args.record:
        check_writable(args.record, "--record")
    mode = PICTURES if args.no_window or not _has_window(env_id, args.env_kwargs) else WINDOW
    env = make_env(env_id, args.env_kwargs, mode)
    try:
        if not all(hasattr(env.unwrapped, name) for name in ("action_sequence", "viewer")):
            raise CommandError(f"{env_id} is none of our environments, whose actions keys are known for")
        if args.record:
            with refused("--record", ValueError):
                env = demonstrations().RecordDemonstrations(env, args.record)
        print(f"{env_id}\n{HELP}", flush=True)
        Game(env, args).play()
    finally:
        env.close()
    if args.record and args.record.exists():
        print(f"{len(demonstrations().load(args.record))} episodes recorded\nWritten:\n  {args.record}")


def _has_window(env_id: str, env_kwargs: dict[str, Any]) -> bool:
    """Whether this machine can show the environment: it leaves the mode out where there is no display."""
    env = make_env(env_id, env_kwargs)
    env.close()
    return WINDOW in env.metadata["render_modes"]


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser(
        "bulletarm-zoo play",
        description=DESCRIPTION,
        epilog=f"keys:\n{HELP}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("env", metavar="ENV", help="environment id, see bulletarm-zoo list")
    add("--record", type=Path, metavar="FILE", help="add successful episodes to this file of demonstrations")
    add("--seed", type=seed, default=0, help="seed of the first episode (default: 0)")
    add("--stride", type=_share, help="share of the farthest move that a key is (default: 2 cm; 1 cm)")
    add("--no-window", action="store_true", help="read letters and save pictures, also with a display")
    add("-f", "--folder", type=Path, default=Path("play"), help="where pictures go (default: play)")
    add_env_kwargs(parser)
    add_packages(parser)
    args = parser.parse_args(argv)
    if args.record is not None and args.record.suffix not in SUFFIXES:
        parser.error(f"--record must end in {' or '.join(SUFFIXES)}, got {args.record}")
    return args


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"must be greater than 0 and at most 1, got {text!r}")
    return value


class Game:
    """
    Episodes that a person plays.

    :param env: The environment; its ``render_mode`` says where keys come from
    :param args: The command's arguments
    """

    def __init__(self, env: gym.Env[Any, Any], args: argparse.Namespace) -> None:
        self.env, self.folder, self.seed = env, args.folder, args.seed
        self.pilot = make_pilot(env, args.stride)
        self.episode = 0

    def play(self) -> None:
        """Play until the keys end."""
        self._begin()
        for key in self._keys():
            if key == NEW_EPISODE:
                self._begin()
            elif key == EXPERT or self.pilot.takes(key):
                self._act(key)
            else:
                print(f"{key!r} is no key here; keys are\n{HELP}", flush=True)

    def _keys(self) -> Iterator[str]:
        """Keys as they are pressed, or the letters of the input, until the one that ends."""
        source = self._window_keys() if self.env.render_mode == WINDOW else _letters()
        for key in source:
            if key == QUIT:
                return
            yield key

    def _window_keys(self) -> Iterator[str]:
        pressed_keys = self.env.get_wrapper_attr("viewer").pressed_keys
        while True:
            try:
                yield from pressed_keys()
            except Exception as error:  # PyBullet's own, once the window has been closed
                print(f"the window was closed ({error})")
                return
            time.sleep(POLL)

    def _begin(self) -> None:
        self.seen, self.info = self.env.reset(seed=self.seed + self.episode)
        self.episode, self.step, self.pictures = self.episode + 1, 0, 0
        self.pilot.reset()
        self._tell("begins")

    def _act(self, key: str) -> None:
        """Do what a key says, and begin anew where that ends the episode."""
        action = self._expert() if key == EXPERT else self.pilot.press(key, self.seen)
        if action is None:
            self._tell("target moved")
            return
        self.seen, _, terminated, truncated, self.info = self.env.step(action)
        self.step += 1
        if not (terminated or truncated):
            self._tell(
                "holding something" if self.pilot.holds(self.seen) else "ignored" * self.info["ignored"]
            )
            return
        self._tell("success" if self.info["is_success"] else "failure")
        self._begin()

    def _expert(self) -> Action:
        action: Action = self.env.get_wrapper_attr("expert_action")()
        self.pilot.follow(action)
        return action

    def _tell(self, what: str) -> None:
        """Say how it stands and, without a window, save a picture."""
        said = f"episode {self.episode}, step {self.step}" + f": {what}" * bool(what)
        if self.env.render_mode == WINDOW:
            self.pilot.show(self.seen)
            print(said, flush=True)
            return
        path = self.folder / f"episode_{self.episode:02d}" / f"{self.pictures:03d}.png"
        self.pictures += 1
        picture = self.env.get_wrapper_attr("viewer").close_up(PANEL_SIZE)
        success = bool(self.info["is_success"])
        write_picture(
            compose_frame(picture, self.seen, self.env.observation_space, said, success, self._target()), path
        )
        print(f"{said}  {path}", flush=True)

    def _target(self) -> ValueMap | None:
        """The heightmap with the place that the gripper would go to, in open loop."""
        if not isinstance(self.pilot, OpenLoopPilot) or "heightmap" not in self.seen:
            return None
        heights = self.seen["heightmap"][0]
        return ValueMap(heights, self.pilot.place(len(heights)), self.pilot.yaw)


def _letters() -> Iterator[str]:
    """Characters of the standard input, white space aside."""
    for line in sys.stdin:
        yield from "".join(line.split())
