"""Flags that describe the agent of ``enjoy``, ``record`` and ``push``."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from zoo_configs.arguments import add_env_kwargs, add_packages, add_progress, seed

if TYPE_CHECKING:
    from zoo_configs.agents import AgentQuery


def add_agent_flags(parser: argparse.ArgumentParser, is_run: bool = False) -> None:
    """Add the flags that describe an agent, with ``is_run`` that of a run, and its test scenes."""
    add = parser.add_argument
    folder = "run folder, as train prints it"
    if is_run:
        add("path", nargs="?", type=Path, metavar="RUN_FOLDER", help=folder)
    else:
        model = f"{folder}, or a model that save() wrote (with --env)"
        add("path", nargs="?", type=Path, metavar="RUN_FOLDER|FILE.zip", help=model)
        published = "load the agent that the package contains for this task, or a folder written by push"
        add("--published", metavar="TASK", help=published)
    add("--env", help="environment id; without a path the newest run on this environment is loaded")
    add("--baseline", help="load the newest run of this baseline")
    add("--algo", help="load the newest run of this algorithm, or of the baseline of this name")
    add("--preset", help="load the newest run with this preset")
    add("-f", "--log-folder", type=Path, default=Path("logs"), help="folder of all runs (default: logs)")
    add("--device", default="auto", help="PyTorch device (default: auto)")
    add("--seed", type=seed, default=0, help="seed of the test scenes (default: 0)")
    best = "load the model with the best evaluation (the default)"
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--load-best", action="store_true", default=True, help=best)
    group.add_argument("--load-last", action="store_false", dest="load_best", help="load the last model")
    add_packages(parser)
    add_env_kwargs(parser)
    add_progress(parser)


def query_of(args: argparse.Namespace) -> AgentQuery:
    """Return the query that the flags of :func:`add_agent_flags` describe."""
    from zoo_configs.agents import AgentQuery

    names = [item.name for item in fields(AgentQuery) if hasattr(args, item.name)]
    return AgentQuery(**{name: getattr(args, name) for name in names})
