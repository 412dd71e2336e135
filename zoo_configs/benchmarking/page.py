"""What came of a benchmark on one page: figure, tables, machines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from zoo_configs.benchmarking.evaluated import EvaluatedRun
from zoo_configs.benchmarking.overview import BENCHMARK_FILE, Status, read_entry
from zoo_configs.benchmarking.results import baseline_table, cell_table, run_table
from zoo_configs.benchmarking.tables import markdown
from zoo_configs.errors import refused
from zoo_configs.files import whole_file
from zoo_configs.training.runs import RUN_KEY, Run


def write_page(folder: Path, runs: Sequence[Run], picture: Path, path: Path) -> None:
    """
    Write the page.

    :param folder: The benchmark's folder
    :param runs: Its runs that have been evaluated
    :param picture: Their figure
    :param path: The Markdown file
    :raises CommandError: if a file of the benchmark cannot be read
    """
    about = _read(folder / BENCHMARK_FILE)
    table = run_table(map(EvaluatedRun.of, runs))
    link = picture.relative_to(path.parent) if picture.is_relative_to(path.parent) else picture
    parts = [
        f"# {about.get('name', folder.name)}",
        f"    {about['command']}" if "command" in about else "",
        _standing(folder, about.get("runs", [run.folder.relative_to(folder).as_posix() for run in runs])),
        f"![Evaluation success over time steps, means over seeds shaded by their standard error]({link})",
        markdown(cell_table(table), baseline_table(table)).strip(),
        "## Machines",
        _machines(runs),
    ]
    with whole_file(path) as partial:
        partial.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    with refused(f"{path} cannot be read"):
        return dict(yaml.safe_load(path.read_text(encoding="utf-8")))


def _standing(folder: Path, names: Iterable[str]) -> str:
    """How many runs are done; which are not, and why."""
    entries = [read_entry(folder, name) for name in names]
    counts = Counter(entry.status for entry in entries)
    line = ", ".join(f"{counts[status]} {status.value}" for status in Status if counts[status])
    others = [entry for entry in entries if entry.status is not Status.DONE]
    return "\n".join([f"Runs: {line}.", *(["", *(f"- {entry}" for entry in others)] if others else [])])


def _machines(runs: Sequence[Run]) -> str:
    """Machines and versions, each with the number of its runs."""
    found: Counter[str] = Counter()
    for run in runs:
        about = _read(run.resolved_file).get(RUN_KEY, {})
        how = run.standing
        versions = ", ".join(f"{name} {version}" for name, version in about.get("versions", {}).items())
        code = f", commit {about['commit']}" if "commit" in about else ""
        found[
            f"{how.host if how else 'unknown'}: {about.get('machine')}, device {run.device}; {versions}{code}"
        ] += 1
    return "\n".join(f"- {count} runs on {machine}" for machine, count in found.most_common())
