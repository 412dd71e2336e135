"""``bulletarm-zoo report``: what came of a benchmark on one page, or measurements on their pages."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from zoo_configs.arguments import Parser
from zoo_configs.errors import CommandError
from zoo_configs.files import check_writable

DESCRIPTION = """Put figure, tables and machines of a benchmark, or of any log folder, on one page. Runs
that are under way count with what they have. With --docs instead: fill the places of Markdown pages that are
marked with <!-- data: NAME --> from files of measurements."""
PAGE = "report.md"
DATA = Path("docs/data")


def main(argv: Sequence[str]) -> None:
    """
    Run the command.

    :param argv: Its arguments
    :raises CommandError: if there is no run to report
    """
    args = _parse(argv)
    if args.docs:
        _fill(args)
    else:
        _report(args)


def _report(args: argparse.Namespace) -> None:
    from zoo_configs.commands.plot import draw_panels, evaluated_runs

    if not args.folder.is_dir():
        raise CommandError(f"there is no folder {args.folder}")
    runs = evaluated_runs(args.folder)
    page = args.output or args.folder / PAGE
    check_writable(page, "--output")
    picture = page.with_suffix(".png")
    from zoo_configs.benchmarking.evaluated import EvaluatedRun
    from zoo_configs.benchmarking.page import write_page

    draw_panels(map(EvaluatedRun.of, runs), picture)
    write_page(args.folder, runs, picture, page)
    print(f"Written:\n  {page}\n  {picture}")


def _fill(args: argparse.Namespace) -> None:
    from zoo_configs.pages.figures import FIGURES
    from zoo_configs.pages.markers import fill_pages, pages_of

    changed = fill_pages(pages_of(args.docs), args.data, FIGURES)
    print("\n".join(["Written:", *(f"  {page}" for page in changed)]) if changed else "Nothing has changed")


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = Parser("bulletarm-zoo report", description=DESCRIPTION)
    add = parser.add_argument
    add("folder", type=Path, nargs="?", metavar="FOLDER", help="folder of a benchmark")
    add("--docs", type=Path, nargs="+", metavar="PAGE", help="instead: Markdown pages, or folders of them")
    add("--data", type=Path, default=DATA, help=f"... and the folder of their data (default: {DATA})")
    add("-o", "--output", type=Path, help=f"Markdown file to write (default: {PAGE} in the folder)")
    args = parser.parse_args(argv)
    if (args.folder is None) == (args.docs is None):
        parser.error("report takes either the folder of a benchmark or pages, behind --docs")
    if args.output is not None and args.output.suffix != ".md":
        parser.error(f"--output must end in .md, got {args.output}")
    return args
