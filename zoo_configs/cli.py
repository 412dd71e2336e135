"""The command line ``bulletarm-zoo``: picks a command, and turns its errors into clear messages."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from typing import NamedTuple

from zoo_configs.errors import CommandError, unknown_name

PROGRAM = "bulletarm-zoo"
EXIT_OK = 0
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, the shell's convention


class Command(NamedTuple):
    """
    A command.

    :param module: Module with a ``main(argv)``, imported when the command is called
    :param summary: What it does
    """

    module: str
    summary: str


COMMANDS = {
    "train": Command("zoo_configs.commands.train", "train an agent, or go on with an interrupted training"),
    "enjoy": Command("zoo_configs.commands.enjoy", "evaluate a trained agent"),
    "record": Command("zoo_configs.commands.record", "film a trained agent or the expert"),
    "plot": Command("zoo_configs.commands.plot", "draw the learning curves of many runs"),
    "demos": Command("zoo_configs.commands.demos", "collect episodes of an expert"),
    "speed": Command("zoo_configs.commands.speed", "measure how fast environments step"),
    "check": Command("zoo_configs.commands.check", "check environments, a user's own above all"),
    "list": Command("zoo_configs.commands.listing", "list environments, or baselines and presets"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param argv: Name of the command and its arguments, default ``sys.argv[1:]``
    :return: Exit code: 0, 2 for wrong usage, 130 after Ctrl-C
    """
    name, *arguments = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
        return EXIT_OK
    try:
        if name not in COMMANDS:
            raise unknown_name("command", name, COMMANDS)
        importlib.import_module(COMMANDS[name].module).main(arguments)
    except CommandError as error:
        print(f"{PROGRAM} {name}: error: {error}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        print(f"\n{PROGRAM} {name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return EXIT_OK


def usage() -> str:
    """
    The help page.

    :return: Its text
    """
    lines = [f"usage: {PROGRAM} COMMAND [ARGUMENTS]", "", "commands:"]
    lines += [f"  {name:<8} {command.summary}" for name, command in COMMANDS.items()]
    lines += ["", f"{PROGRAM} COMMAND --help tells the arguments of a command."]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
