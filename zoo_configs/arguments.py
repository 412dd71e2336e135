"""Flags that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path


def positive_int(text: str) -> int:
    """
    Argument type for counts.

    :param text: What was given
    :return: The count, at least 1
    :raises argparse.ArgumentTypeError: for anything else
    """
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return int(text)


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """
    Add the flags by which commands find a trained agent.

    :param parser: Parser of the command
    """
    add = parser.add_argument
    add("run", nargs="?", type=Path, metavar="RUN_FOLDER", help="a run folder, as train names it at its end")
    add("--env", help="instead of a folder: newest run on this environment")
    add("--baseline", help="... of this baseline")
    add("--algo", help="... of this algorithm")
    add("--preset", help="... of this preset")
    add("--exp-id", type=int, default=0, help="... with this number (default: 0, the newest)")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of all runs (default: logs)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add("--gym-packages", nargs="+", default=[], help="packages that register further environments")
    model = parser.add_mutually_exclusive_group()
    model.add_argument("--load-best", action="store_true", default=True, help="take the best model (default)")
    model.add_argument("--load-last", action="store_false", dest="load_best", help="take the last model")
