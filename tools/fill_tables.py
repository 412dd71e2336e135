"""Fill the tables and sentences of Markdown pages from the files in docs/data.

python tools/fill_tables.py docs README.md

The text between <!-- data: NAME --> and <!-- end of data --> is replaced. FIGURES lists the names.
"""

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from statistics import fmean, geometric_mean
from textwrap import indent

from bulletarm_gym.benchmarks import BENCHMARKS
from expert_tables import (
    ID,
    OPEN_LOOP,
    UNEVEN,
    Source,
    expert_table,
    grid_table,
    is_level,
    is_of_paper,
    origins,
    other_experts,
)
from measurements import DATA, Row, runs_of_tasks
from zoo_configs.drawing.tables import markdown_table
from zoo_configs.experiments.families import task_name
from zoo_configs.files import whole_file

BEGIN = r"(?<!`)<!-- data: "
"""Start of a marker outside backticks."""
PLACE = re.compile(rf"({BEGIN}(?P<name>[^>]*?) -->).*?(<!-- end of data -->)", re.DOTALL)
SPEED_HEADS = {
    "calibration_us": ("calibration us", 1),
    "steps_per_second": ("steps/s", 0),
    "step_ms": ("ms/step", 2),
    "physics_ms": ("physics", 2),
    "rendering_ms": ("rendering", 2),
    "rest_ms": ("rest", 2),
    "without_expert_ms": ("without expert", 2),
    "unsimulated": ("steps without simulation", 2),
    "reset_ms": ("reset ms", 1),
    "reference_steps_per_second": ("reference steps/s", 1),
    "times_reference": ("ratio", 1),
}
"""Column of the page and digits, by column of the file."""
ABLATION_STEPS = (-3000, 0, 5000, 10000)
"""Time steps of the evaluations in the table; those before 0 precede the first step."""
PARTS = ("gradients_of_convolutions", "convolutions", "pooling", "rest")


def speed_table(source: Source) -> str:
    """Return the speed of the environments with default parameters."""
    rows = [row for row in source.read("speed") if not row["env_kwargs"]]
    lines = []
    for row in rows:
        digits = {name: digits for name, (_, digits) in SPEED_HEADS.items()}
        figures = [f"{float(row[name]):.{digits[name]}f}" if row[name] else "" for name in digits]
        lines.append([f"`{row['env']}`", *figures, f"{float(row['success']):.2f} of {row['episodes']}"])
    table = markdown_table(["environment", *(head for head, _ in SPEED_HEADS.values()), "expert"], lines)
    load = f"load average when a row began at most {max(float(row['load']) for row in rows):.1f}"
    return f"{table}\n\n{origins(rows)}, {load} ({source.link('speed')})."


def ratio_sentence(source: Source) -> str:
    """Return the comparison of the speed with the reference."""
    closed, opened = _ratios(source)
    return (
        f"The geometric mean of the ratios is {geometric_mean(closed):.1f} for the {len(closed)} closed-loop "
        f"tasks of the paper (minimum {min(closed):.1f}) and {geometric_mean(opened):.1f} for its "
        f"{len(opened)} open-loop tasks (minimum {min(opened):.1f})."
    )


def ratio_summary(source: Source) -> str:
    """Return the comparison of the speed with the reference in short."""
    closed, opened = _ratios(source)
    both = (*closed, *opened)
    return (
        f"{min(both):.0f} to {max(both):.0f} times as fast as the original release (geometric mean "
        f"{geometric_mean(closed):.0f} in closed loop, {geometric_mean(opened):.0f} in open loop)"
    )


def _ratios(source: Source) -> list[list[float]]:
    """Return the ratios in closed and in open loop."""
    rows = [row for row in source.read("speed") if row["times_reference"] and not row["env_kwargs"]]
    opened = [float(row["times_reference"]) for row in rows if row["env"].startswith(OPEN_LOOP)]
    return [[float(row["times_reference"]) for row in rows if row["env"].startswith("CloseLoop")], opened]


def update_table(source: Source, control: str) -> str:
    """Return the durations of updates and of their parts."""
    rows = [row for row in source.read("updates") if row["env"].startswith(control)]
    heads = ["baseline", "preset", "device", "ms an update", "peak GB"]
    heads += [*(part.replace("_", " ") for part in PARTS), "equivariant over plain"]
    lines = [
        [
            *(f"`{row['baseline']}`", f"`{row['preset']}`", row["device"], f"{float(row['update_ms']):,.1f}"),
            *(row["peak_gigabytes"], *(_percent(row[part]) for part in PARTS), row["equivariant_over_plain"]),
        ]
        for row in rows
    ]
    return source.table("updates", heads, lines, rows)


def overhead_table(source: Source) -> str:
    """Return the overhead of ``train``."""
    rows = source.read("overhead")
    heads = ["baseline", "time steps", "model.learn() CPU s", "train CPU s", "overhead", "range"]
    lines = [
        [
            *(f"`{row['baseline']}`", row["timesteps"], row["bare_seconds"], row["train_seconds"]),
            *(_percent(row["overhead"], 1), f"{_percent(row['least'], 1)} to {_percent(row['greatest'], 1)}"),
        ]
        for row in rows
    ]
    return source.table("overhead", heads, lines, rows)


def _percent(share: str, digits: int = 0) -> str:
    return f"{float(share) * 100:.{digits}f} %" if share else ""


def deconstruction_table(source: Source) -> str:
    """Return the rates at which structures are collected by deconstruction."""
    rows = [row for row in source.read("collecting") if row["planner"] == "deconstruction"]
    figures = ("episodes", "attempts", "mean_steps", "episodes_per_minute", "load")
    lines = [[f"`{row['env']}`", *(row[column] for column in figures)] for row in rows]
    heads = (ID, "episodes", "attempts", "steps", "a minute", "load")
    return source.table("collecting", heads, lines, rows)


RESULT_HEADS = (
    *("task", "baseline", "demonstrations, updates on them, steps", "seeds", "best", "last"),
    *("range in the second half", "minutes", "commit, date"),
)
TRAINING = ("env", "options", "baseline", "demonstrations", "noise", "dagger", "updates", "steps")
"""Columns that runs with different seeds share."""


def results_table(source: Source, preset: str, tasks: str) -> str:
    """Return the results of runs; seeds share a row."""
    trainings: dict[tuple[str, ...], list[Row]] = {}
    for run in source.read("results"):
        if run["preset"] == preset and fnmatchcase(run["env"], tasks):
            trainings.setdefault(tuple(run[name] for name in TRAINING), []).append(run)
    in_order = sorted(trainings.values(), key=lambda runs: runs[0]["env"])
    lines = [_result(sorted(runs, key=lambda run: int(run["seed"]))) for runs in in_order]
    return markdown_table(RESULT_HEADS, lines, text_columns=4)


def results_summary(source: Source) -> str:
    """Return the success rate of each task's last agent with the preset ``cpu``."""
    lines, rates = [], []
    for task, runs in sorted(runs_of_tasks(source.read("results")).items()):
        minutes = [float(run["minutes"]) for run in runs if run["minutes"]]
        rates.append(fmean(float(run["last"]) for run in runs if run["last"]))
        lines.append([f"`{task}`", f"{rates[-1]:.2f}", f"{fmean(minutes):.0f}" if minutes else ""])
    table = markdown_table(("task", "success", "minutes"), lines)
    at_least = {limit: sum(round(rate, 2) >= limit for rate in rates) for limit in (0.90, 0.95)}
    counts = ", ".join(f"{number} have {limit:.2f} or more" for limit, number in at_least.items())
    tasks = {env.env_id for benchmark in BENCHMARKS.values() for env in benchmark.environments}
    return f"{table}\n\n{len(rates)} of the paper's {len(tasks)} tasks have been trained: {counts}."


def _result(runs: Sequence[Row]) -> list[str]:
    first = runs[0]
    task = first["env"].removeprefix("CloseLoop").removeprefix(OPEN_LOOP)
    demonstrations, updates, steps = (
        f"{int(first[name]):,}" for name in ("demonstrations", "updates", "steps")
    )
    noise, dagger = (" with noise" if first["noise"] else ""), (" with DAgger" if first["dagger"] else "")
    minutes = [float(run["minutes"]) for run in runs if run["minutes"]]
    return [
        f"{task} (`{first['options']}`)" if first["options"] else task,
        f"`{first['baseline']}`",
        f"{demonstrations}{noise}, {updates}, {steps}{dagger}",
        ", ".join(run["seed"] for run in runs),
        *(_mean([float(run[name]) for run in runs if run[name]]) for name in ("best", "last")),
        "; ".join(
            f"{float(run['least']):.2f} to {float(run['greatest']):.2f}" for run in runs if run["least"]
        ),
        f"{fmean(minutes):.0f}" if minutes else "",
        "; ".join(dict.fromkeys(map(_date, runs))),
    ]


def _mean(rates: Sequence[float]) -> str:
    """Return the mean, followed by the values if there are several."""
    values = ", ".join(f"{rate:.2f}" for rate in rates)
    return f"{fmean(rates):.2f} ({values})" if len(rates) > 1 else values


def demonstrations_table(source: Source) -> str:
    """Return the success in the last evaluation over the number of demonstrations."""
    rows = source.read("demonstrations")
    tasks: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        count, last = int(row["baseline"].rpartition("=")[2]), float(row["evaluations"].rpartition(":")[2])
        tasks.setdefault(row["env"], {}).setdefault(count, []).append(last)
    counts = sorted({count for rates in tasks.values() for count in rates})
    lines = [
        [f"`{task_name(env)}`", *(_mean(rates.get(count, [])) for count in counts)]
        for env, rates in sorted(tasks.items())
    ]
    return source.table("demonstrations", ["task", *map(str, counts)], lines, rows)


def ablation_table(source: Source, name: str) -> str:
    """Return the success of the complete learner and of its variants, each without one addition."""
    rows = [row for row in source.read(name) if row["state"] == "done"]
    runs: dict[tuple[str, str], list[dict[int, float]]] = {}
    for row in rows:
        pairs = (pair.split(":") for pair in row["evaluations"].split())
        run = task_name(row["env"]), row["baseline"].rpartition(", ")[2]
        runs.setdefault(run, []).append({int(step): float(rate) for step, rate in pairs})
    lines = [
        [f"`{task}`", f"`{variant}`", *(_mean([curve[step] for curve in curves]) for step in ABLATION_STEPS)]
        for (task, variant), curves in sorted(runs.items(), key=lambda item: item[0][0])
    ]
    heads = ["task", "variant", *(f"{step:,} steps" for step in ABLATION_STEPS)]
    return source.table(name, heads, lines, rows)


def _date(run: Row) -> str:
    return ", ".join(part for part in (run["commit"], run["date"]) if part)


FIGURES: dict[str, Callable[[Source], str]] = {
    "experts, open loop": partial(expert_table, belongs=is_level),
    "experts, open loop, ramps and bumps": partial(
        expert_table, belongs=lambda name: name.startswith(UNEVEN)
    ),
    "experts, close loop": partial(
        expert_table, belongs=lambda name: is_of_paper(name) and not name.startswith(OPEN_LOOP)
    ),
    "experts, composed": partial(
        expert_table, belongs=lambda name: not is_of_paper(name) and not name.startswith(OPEN_LOOP)
    ),
    "experts, elsewhere": other_experts,
    "experts on the grid": grid_table,
    "speed": speed_table,
    "speed, means": ratio_sentence,
    "speed, in short": ratio_summary,
    "updates, close loop": partial(update_table, control="CloseLoop"),
    "updates, open loop": partial(update_table, control=OPEN_LOOP),
    "overhead": overhead_table,
    "deconstruction": deconstruction_table,
    "results, in short": results_summary,
    "results, close loop": partial(results_table, preset="cpu", tasks="CloseLoop*"),
    "results, open loop": partial(results_table, preset="cpu", tasks="OpenLoop*"),
    "demonstrations": demonstrations_table,
    "ablation": partial(ablation_table, name="ablation"),
    "ablation, remaining": partial(ablation_table, name="ablation_remaining"),
    "results, many demonstrations": partial(results_table, preset="quick", tasks="CloseLoop*"),
}
"""Functions that return the text of a place, by name."""


def filled(page: Path, folder: Path = DATA) -> str:
    """Return the text of a Markdown page with its places filled from the files in a folder."""
    source, text = Source(folder, page), page.read_text(encoding="utf-8")

    def fill(place: re.Match[str]) -> str:
        """Return the content of one place between its comments."""
        if place["name"] not in FIGURES:
            near = difflib.get_close_matches(place["name"], FIGURES, 1)
            sys.exit(
                f"{page}: unknown data {place['name']!r}" + (f", did you mean {near[0]!r}?" if near else "")
            )
        content = FIGURES[place["name"]](source)
        if "\n" not in content:  # a sentence is part of a paragraph
            return f"{place[1]}{content}{place[3]}"
        line = text[: place.start()].rpartition("\n")[2]
        before = line if not line.strip() else ""  # indentation in a fold
        return indent(f"{place[1]}\n\n{content}\n\n{place[3]}", before).removeprefix(before)

    if len(re.findall(BEGIN, text)) != len(PLACE.findall(text)):
        sys.exit(f"{page}: <!-- end of data --> is missing")
    return PLACE.sub(fill, text)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("page", type=Path, nargs="+", help="Markdown files, or folders of them")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the data (default: docs/data)")
    args = parser.parse_args()
    pages = [page for path in args.page for page in (sorted(path.rglob("*.md")) if path.is_dir() else [path])]
    texts = {page: filled(page, args.data) for page in pages}  # before any page is written
    for page, text in texts.items():
        if text != page.read_text(encoding="utf-8"):
            with whole_file(page) as partial_file:
                partial_file.write_text(text, encoding="utf-8")
            print(page)


if __name__ == "__main__":
    main()
