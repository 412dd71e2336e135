"""Check this machine, or with ``--robot`` a robot. The exit status is 2 if a check fails."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from bulletarm_gym.check.environments import check_environments
from bulletarm_gym.check.machine import report
from bulletarm_gym.check.robot import check_robot, draw
from bulletarm_gym.registry import ROBOTS

SECONDS = 2.0
"""Default duration (s) of each speed measurement."""
FAILED = 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run the checks and return the exit status."""
    parser = argparse.ArgumentParser("python -m bulletarm_gym.check", description=__doc__)
    add = parser.add_argument
    add("--seconds", type=float, default=SECONDS, help=f"duration of each speed measurement ({SECONDS:g} s)")
    add("--robot", metavar="NAME", help="name of a robot, or module:attribute of a RobotModel")
    add("--workspace", type=float, nargs=6, metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"), help="limits (m)")
    add("--image", type=Path, metavar="FILE", help="image of the robot to write")
    args = parser.parse_args(argv)
    if not 0.0 < args.seconds < float("inf"):
        parser.error(f"--seconds must be positive, got {args.seconds}")
    if args.robot is None and (args.workspace or args.image):
        parser.error("--robot must be passed with --workspace and --image")
    if args.image is not None:
        _check_image(parser, args.image)
    try:
        failed = _check_robot(args) if args.robot else report(check_environments(args.seconds))
    except ValueError as error:
        failed = [" ".join(str(error).split())]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return FAILED if failed else 0


def _check_robot(args: argparse.Namespace) -> list[str]:
    """Report on a robot and write its image; return the subjects of failed checks."""
    model = ROBOTS.find(args.robot)
    workspace = None if args.workspace is None else np.reshape(args.workspace, (3, 2)).tolist()
    failed = report(check_robot(model, workspace))
    if args.image is not None:
        draw(model, workspace, args.image)
    return failed


def _check_image(parser: argparse.ArgumentParser, path: Path) -> None:
    """Exit with a message if no image can be written to a path."""
    if path.suffix.lower() not in Image.registered_extensions():
        parser.error(f"--image must be a file name with the extension of an image, got {path}. Use .png.")
    if not path.absolute().parent.is_dir():
        parser.error(f"--image must be in an existing folder, got {path}")


if __name__ == "__main__":
    sys.exit(main())
