"""Check this machine, the environments with the passed ids, or with ``--robot`` a robot.

The exit status is 2 if a check fails.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from bulletarm_gym.check.conformance import check_environment, draw_episode
from bulletarm_gym.check.environments import check_environments
from bulletarm_gym.check.machine import report
from bulletarm_gym.check.robot import check_robot, draw
from bulletarm_gym.command_line import add_environment_arguments, integer_from, make_env, reported_errors
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.registry import ROBOTS

IDS = ("ids",)
SUBJECTS = {
    **dict.fromkeys(("episodes", "seed", "env_kwargs", "gym_packages"), IDS),
    **{"workspace": ("--robot",), "image": ("--robot", *IDS), "seconds": ("",)},
}
"""What each argument applies to: ids, a robot, or "" for this machine."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the checks and return the exit status."""
    parser = argparse.ArgumentParser("python -m bulletarm_gym.check", description=__doc__)
    add = parser.add_argument
    add("env", nargs="*", metavar="ID", help="ids of environments to check with their experts")
    add("-n", "--episodes", type=integer_from(1), default=20, help="episodes per expert (%(default)s)")
    add_environment_arguments(parser)
    add("--seconds", type=float, default=2.0, help="duration of each speed measurement (%(default)g s)")
    add("--robot", metavar="NAME", help="name of a robot, or module:attribute of a RobotModel")
    add("--workspace", type=float, nargs=6, metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"), help="limits (m)")
    text = "image to write of the robot, or of an expert's episode"
    add("--image", type=_image_path, metavar="FILE", help=text)
    args = parser.parse_args(argv)
    _check_arguments(parser, args)
    with reported_errors(parser):
        for env_id in args.env:
            make_env(env_id, args).close()
    try:
        failed = _check(args)
    except ValueError as error:
        failed = [" ".join(str(error).split())]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 2 if failed else 0


def _image_path(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in Image.registered_extensions() or not path.absolute().parent.is_dir():
        raise argparse.ArgumentTypeError(f"must be an image in an existing folder, got {text}. Use .png.")
    return path


def _check_arguments(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Exit with a message if arguments do not fit together."""
    if args.robot is not None and args.env:
        parser.error("--robot must be passed without ids. Use --env-kwargs robot:NAME.")
    subject = "--robot" if args.robot is not None else "ids" if args.env else ""
    for name, subjects in SUBJECTS.items():
        if subject not in subjects and getattr(args, name) != parser.get_default(name):
            must = " or ".join(filter(None, subjects)) or "neither --robot nor ids"
            parser.error(f"--{name.replace('_', '-')} must be passed with {must}")
    if args.image is not None and len(args.env) > 1:
        parser.error("--image must be passed with one id")


def _check(args: argparse.Namespace) -> list[str]:
    """Run the checks that the arguments select, and write an image; return the subjects of failed checks."""
    if args.robot is not None:
        model = ROBOTS.find(args.robot)
        workspace = None if args.workspace is None else np.reshape(args.workspace, (3, 2)).tolist()
        failed = report(check_robot(model, workspace))
        if args.image is not None:
            draw(model, workspace, args.image)
        return failed
    if not args.env:
        return report(check_environments(args.seconds))
    return [env_id for env_id in args.env if _check_environment(env_id, args)]


def _check_environment(env_id: str, args: argparse.Namespace) -> bool:
    """Report on an environment and write an image; return True if a check failed."""

    def make() -> ManipulationEnv:
        return make_env(env_id, args).unwrapped  # type: ignore[return-value]

    print(env_id, flush=True)
    failed = report(check_environment(make, args.episodes, args.seed))
    if args.image is not None:
        draw_episode(make, args.seed, args.image)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
