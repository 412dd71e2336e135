"""``bulletarm-zoo doctor``: looks whether all is well on this machine."""

from __future__ import annotations

import math
from collections.abc import Sequence

from zoo_configs.arguments import Parser
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError

DESCRIPTION = """Look at what decides how well environments and trainings run here: versions, processor,
threads, display, one episode of each arm, the cache of compiled code, speed beside plain PyBullet. What could
be better is told with what to do about it."""


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if something does not work
    """
    parser = Parser("bulletarm-zoo doctor", description=DESCRIPTION)
    add = parser.add_argument
    add("--seconds", type=float, default=2.0, help="how long to measure each speed (default: 2)")
    args = parser.parse_args(argv)
    if not 0 < args.seconds < math.inf:
        parser.error(f"--seconds must be positive, got {args.seconds}")
    register_environments()
    from bulletarm_gym.check.machine import report
    from zoo_configs.measuring import health

    if failed := report(health.look_at(args.seconds)):
        raise CommandError(f"does not work here: {', '.join(failed)}")
