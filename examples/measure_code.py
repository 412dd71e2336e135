"""Size of the code: files, lines and functions of each package, as a commit has them, kept in a file of data.

python examples/measure_code.py --stand now
python examples/measure_code.py --stand "before the rooms" --commit 8dff686~1
"""

from __future__ import annotations

import argparse
import ast
import datetime
import shlex
import statistics
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from zoo_configs.measuring.data_files import CODE, DataFile
from zoo_configs.measuring.provenance import DIGITS

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "docs" / "data" / "code.csv"
PACKAGES = ("bulletarm_gym", "sb3_extensions", "zoo_configs")
ALL = "all"
PERCENTILE = 90
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


class Source(NamedTuple):
    """A file of a commit.

    :param path: from the repository's root
    :param text: what stands in it
    """

    path: str
    text: str


def main() -> None:
    """Measure one commit and put its rows into the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--stand", required=True, help="name of the rows; those that have it already go")
    parser.add_argument("--commit", default="HEAD", help="what to measure (default: HEAD)")
    parser.add_argument("--data", type=Path, default=DATA, help="CSV to put the rows into")
    args = parser.parse_args()
    file = DataFile(args.data, CODE)
    sources = list(_sources(args.commit))
    for package in (*PACKAGES, ALL):
        own = [source for source in sources if package in (ALL, source.path.partition("/")[0])]
        row = {"stand": args.stand, "package": package, **measure(own)}
        file.add({**row, **_provenance(args.stand, args.commit)})
        print(", ".join(f"{name} {value}" for name, value in row.items()))


def measure(sources: list[Source]) -> dict[str, str]:
    """Measure some files.

    :param sources: Python files
    :return: a value for each figure of ``CODE``
    """
    lengths = sorted(length for source in sources for length in body_lengths(source.text))
    lines = [len(source.text.splitlines()) for source in sources]
    ninety = lengths[max(0, -(-len(lengths) * PERCENTILE // 100) - 1)]
    return {
        "files": str(len(sources)),
        "lines": str(sum(lines)),
        "functions": str(len(lengths)),
        "median_body": f"{statistics.median(lengths):g}",
        "p90_body": str(ninety),
        "longest_body": str(lengths[-1]),
        "longest_file": str(max(lines)),
    }


def body_lengths(text: str) -> Iterator[int]:
    """Measure functions.

    :param text: a Python file
    :return: lines of each body, from the first statement behind its docstring to the last, 0 without one
    """
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, FUNCTIONS):
            body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
            yield (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def _sources(commit: str) -> Iterator[Source]:
    for path in _git("ls-tree", "-r", "--name-only", commit, *PACKAGES).splitlines():
        if path.endswith(".py"):
            yield Source(path, _git("show", f"{commit}:{path}"))


def _provenance(stand: str, commit: str) -> dict[str, str]:
    """Of the commit that is measured; no machine has a part in it."""
    found = _git("rev-parse", f"--short={DIGITS}", commit).strip()
    command = ["python", "examples/measure_code.py", "--stand", stand, "--commit", found]
    today = datetime.date.today().isoformat()
    return {"machine": "", "date": today, "commit": found, "command": shlex.join(command)}


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    main()
