"""The command line ``bulletarm-zoo``: picks a command, and turns its errors into clear messages."""

from __future__ import annotations

import importlib
import os
import select
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from typing import NamedTuple

from zoo_configs.errors import CommandError, reason, reason_and_place, unknown_name

PROGRAM = "bulletarm-zoo"
DISTRIBUTION = "bulletarm-gym"
TRACEBACK = "--traceback"
EXIT_OK = 0
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, the shell's convention
EXIT_UNREAD = 141  # 128 + SIGPIPE


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
    "tune": Command("zoo_configs.commands.tune", "search hyperparameters with Optuna"),
    "enjoy": Command("zoo_configs.commands.enjoy", "evaluate a trained agent"),
    "record": Command("zoo_configs.commands.record", "film a trained agent or the expert"),
    "push": Command(
        "zoo_configs.commands.push", "put a trained agent on the Hugging Face hub, or into a folder"
    ),
    "gallery": Command("zoo_configs.commands.gallery", "draw tasks, as they begin and solved"),
    "play": Command("zoo_configs.commands.play", "move the gripper yourself, by keys, and record it"),
    "benchmark": Command(
        "zoo_configs.commands.benchmark", "train all cells of a benchmark, also on a cluster"
    ),
    "results": Command("zoo_configs.commands.results", "evaluate runs and keep a table of what they reached"),
    "report": Command("zoo_configs.commands.report", "put the results of a benchmark on one page"),
    "plot": Command("zoo_configs.commands.plot", "draw the learning curves of many runs"),
    "demos": Command("zoo_configs.commands.demos", "collect episodes of an expert"),
    "speed": Command("zoo_configs.commands.speed", "measure how fast environments step"),
    "check": Command("zoo_configs.commands.check", "check environments, a user's own above all"),
    "doctor": Command("zoo_configs.commands.doctor", "look whether all is well on this machine"),
    "list": Command("zoo_configs.commands.listing", "list environments, or baselines and presets"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param argv: Name of the command and its arguments, default ``sys.argv[1:]``
    :return: Exit code: 0, 2 for what cannot be done, 130 after Ctrl-C, 141 if nobody reads what is printed
    """
    words = list(sys.argv[1:] if argv is None else argv)
    raises = words[:1] == [TRACEBACK]
    name, *arguments = (words[1:] if raises else words) or ["--help"]
    try:
        with _working_directory_on_path():
            _run(name, arguments)
        sys.stdout.flush()
    except (CommandError, OSError) as error:
        if raises or not _is_told(error):
            raise
        return _tell(name, error)
    except Exception as error:  # of a user's task or policy, most likely
        if raises:
            raise
        return _tell_where(name, error)
    except KeyboardInterrupt:
        print(f"\n{PROGRAM} {name}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return EXIT_OK


def _run(name: str, arguments: Sequence[str]) -> None:
    if name in ("-h", "--help"):
        print(usage())
    elif name == "--version":
        print(f"{PROGRAM} {metadata.version(DISTRIBUTION)}")
    elif name in COMMANDS:
        importlib.import_module(COMMANDS[name].module).main(arguments)
    else:
        raise unknown_name("command", name, COMMANDS)


@contextmanager
def _working_directory_on_path() -> Iterator[None]:
    """As with ``python -m``: a user's tasks beside which the command is called can be imported."""
    here = os.getcwd()
    if here in sys.path or getattr(sys.flags, "safe_path", False):  # the flag is of Python 3.11
        yield
        return
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)


def _is_told(error: Exception) -> bool:
    """Whether a line says enough of an error: a full disk, but not trouble between our own processes."""
    if isinstance(error, BrokenPipeError):
        return _is_unread()
    of_system = isinstance(error, OSError) and error.errno is not None
    return isinstance(error, CommandError) or (of_system and not isinstance(error, ConnectionError))


def _is_unread() -> bool:
    """Whether who read the output, such as ``head``, has gone."""
    poll = select.poll()
    try:
        poll.register(sys.stdout, select.POLLOUT)
    except OSError:  # it is no file
        return False
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _tell(name: str, error: Exception) -> int:
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is still to be printed
        return EXIT_UNREAD
    print(f"{PROGRAM} {name}: error: {reason(error)}", file=sys.stderr)
    return EXIT_USAGE


def _tell_where(name: str, error: Exception) -> int:
    """In one line what went wrong, in which line of which file, and how to see all that led there."""
    asks = f"{PROGRAM} {TRACEBACK} {name} ... shows how it came about"
    print(f"{PROGRAM} {name}: error: {reason_and_place(error)}; {asks}", file=sys.stderr)
    return EXIT_USAGE


def usage() -> str:
    """
    The help page.

    :return: Its text
    """
    lines = [f"usage: {PROGRAM} [--version] [{TRACEBACK}] COMMAND [ARGUMENTS]", "", "commands:"]
    lines += [f"  {name:<9} {command.summary}" for name, command in COMMANDS.items()]
    lines += ["", f"{PROGRAM} COMMAND --help tells the arguments of a command."]
    lines += [f"{TRACEBACK} shows where an error arose, for those who extend the program."]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
