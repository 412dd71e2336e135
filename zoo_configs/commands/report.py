"""``bulletarm-zoo report``: what came of a benchmark, on one page."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from zoo_configs.arguments import Parser
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable

DESCRIPTION = """Put figure, tables and machines of a benchmark, or of any log folder, on one page. Runs
that are under way count with what they have."""
PAGE = "report.md"


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no run to report
    """
    args = _parse(argv)
    from zoo_configs.commands.plot import draw_panels, evaluated_runs

    if not args.folder.is_dir():
        raise CommandError(f"there is no folder {args.folder}")
    runs = evaluated_runs(args.folder)
    page = args.output or args.folder / PAGE
    check_writable(page, "--output")
    picture = page.with_suffix(".png")
    from zoo_configs.benchmarking.page import write_page

    draw_panels(runs, picture)
    write_page(args.folder, runs, picture, page)
    print(f"Written:\n  {page}\n  {picture}")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo report", description=DESCRIPTION)
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder of a benchmark")
    add("-o", "--output", type=Path, help=f"Markdown file to write (default: {PAGE} in the folder)")
    args = parser.parse_args(argv)
    if args.output is not None and args.output.suffix != ".md":
        parser.error(f"--output must end in .md, got {args.output}")
    return args
