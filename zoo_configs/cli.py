"""The command line ``bulletarm-zoo``: runs a command and prints its errors in one line."""

import contextlib
import importlib
import os
import select
import sys
from collections.abc import Sequence
from importlib import metadata
from importlib.util import find_spec

from zoo_configs.errors import CommandError, reason, reason_and_place, unknown_name

PROGRAM = "bulletarm-zoo"
DISTRIBUTION = "bulletarm-gym"
TRACEBACK = "--traceback"
COMMANDS = {
    "train": "train an agent, or resume a training",
    "tune": "search hyperparameters with Optuna",
    "enjoy": "evaluate a trained agent",
    "verify": "train the first updates of an agent again, and compare",
    "record": "record a video of a trained agent or of the expert",
    "push": "upload a trained agent to the Hugging Face hub, or write it to a folder",
    "benchmark": "train all experiments of a benchmark, on one machine or on a cluster",
    "plot": "draw the learning curves and print the results of many runs",
    "demos": "collect demonstrations of an expert",
    "list": "list environments, baselines, presets or published agents",
}
REQUIRED = ("stable_baselines3", "torch", "optuna", "yaml", "matplotlib", "pandas", "imageio")
"""Some modules of packages that the extra ``zoo`` installs."""


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command, by default that of ``sys.argv``.

    :return: Exit code: 0; 2 for an error; 130 after Ctrl-C; 141 if the reader of the output has gone
    """
    words = list(sys.argv[1:] if argv is None else argv)
    raises = words[:1] == [TRACEBACK]
    name, *arguments = (words[1:] if raises else words) or ["--help"]
    try:
        if os.getcwd() not in sys.path and not getattr(sys.flags, "safe_path", False):  # of Python 3.11
            sys.path.insert(0, os.getcwd())  # as ``python -m`` does
        _run(name, arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print(f"\n{PROGRAM} {name}: interrupted", file=sys.stderr)
        return 130  # 128 + SIGINT, the shell's convention
    except Exception as error:
        if raises:
            raise
        return _report(name, error)
    return 0


def _run(name: str, arguments: Sequence[str]) -> None:
    if name in ("-h", "--help"):
        print(usage())
    elif name == "--version":
        print(f"{PROGRAM} {metadata.version(DISTRIBUTION)}")
    elif name in COMMANDS:
        if missing := [module for module in REQUIRED if find_spec(module) is None]:
            raise CommandError(f"{', '.join(missing)} not installed: pip install 'bulletarm-gym[zoo]'")
        args = getattr(importlib.import_module("zoo_configs.parsers"), f"parse_{name}")(arguments)
        importlib.import_module(f"zoo_configs.commands.{name}").main(args)
    else:
        raise unknown_name("command", name, COMMANDS)


def _is_unread() -> bool:
    """Return True if the reader of the output, such as ``head``, has gone."""
    poll = select.poll()
    with contextlib.suppress(OSError):  # not a file
        poll.register(sys.stdout, select.POLLOUT)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _report(name: str, error: Exception) -> int:
    """Print an error in one line and return the exit code."""
    if isinstance(error, BrokenPipeError) and _is_unread():
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the remaining output
        return 141  # 128 + SIGPIPE
    if isinstance(error, CommandError) or (isinstance(error, OSError) and error.errno is not None):
        message = reason(error)
    else:  # most likely in a user's task or policy
        hint = f"{PROGRAM} {TRACEBACK} {name} ... shows the traceback"
        message = f"{reason_and_place(error)}; {hint}"
    print(f"{PROGRAM} {name}: error: {message}", file=sys.stderr)
    return 2


def usage() -> str:
    """Return the help page."""
    lines = [f"usage: {PROGRAM} [--version] [{TRACEBACK}] COMMAND [ARGUMENTS]", "", "commands:"]
    lines += [f"  {name:<9} {summary}" for name, summary in COMMANDS.items()]
    lines += ["", f"{PROGRAM} COMMAND --help shows the arguments of a command."]
    lines += [f"{TRACEBACK} shows the traceback of an error."]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
