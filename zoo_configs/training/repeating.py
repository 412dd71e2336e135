"""The command line that trains a run again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from zoo_configs.cells.cell import Cell, resolve
from zoo_configs.errors import CommandError
from zoo_configs.provenance import command_line, env_kwargs_words, key_values
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import Run


def repeating_command(run: Run) -> str:
    """
    The command line that trains a run again.

    :param run: The run
    :return: What to type
    """
    cell, options = run.cell, run.options
    words = ["bulletarm-zoo", "train", "--env", cell.env_id, "--seed", str(run.seed)]
    base = _base(cell)
    if base is None:
        words += ["--conf-file", str(run.resolved_file), "--algo", cell.algo]
    else:
        words += ["--baseline", str(cell.baseline), "--preset", str(cell.preset)]
        words += ["--benchmark", cell.benchmark] if cell.benchmark else []
    words += [] if run.device == "auto" else ["--device", run.device]
    words += ["--gym-packages", *run.gym_packages] if run.gym_packages else []
    words += _flags(TrainingOptions.of(base) if base else TrainingOptions(), options)
    changed = _difference(base.hyperparams, cell.hyperparams) if base else {}
    words += env_kwargs_words(changed.pop("env_kwargs", {}))
    words += ["-params", *key_values(changed)] if changed else []
    return command_line(words)


def _base(cell: Cell) -> Cell | None:
    """The cell without overrides; None if there is none, or a command line cannot say them."""
    if cell.baseline is None or cell.preset is None:
        return None
    try:
        base = resolve(cell.baseline, cell.preset, cell.env_id, benchmark=cell.benchmark)
        changed = _difference(base.hyperparams, cell.hyperparams)
        again = resolve(cell.baseline, cell.preset, cell.env_id, changed, cell.benchmark)
    except CommandError:  # of another version, which had other names
        return None
    return base if again.hyperparams == cell.hyperparams else None


def _difference(base: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """What must be merged into a mapping to get another."""
    changed: dict[str, Any] = {}
    for key, value in wanted.items():
        below = base.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            if inner := _difference(below, value):
                changed[key] = inner
        elif key not in base or below != value:
            changed[key] = value
    return changed


def _flags(base: TrainingOptions, wanted: TrainingOptions) -> Iterator[str]:
    """Options that differ from a cell's own."""
    plain = base.plain()
    for name, value in wanted.plain().items():
        if value == plain[name] or value is None:
            continue
        yield f"--{name.replace('_', '-')}"
        if isinstance(value, Mapping):
            yield from (f"{key}:{item!r}" for key, item in value.items())
        elif isinstance(value, list):
            yield from value
        elif value is not True or name == "truncate_last_trajectory":
            yield str(value)
