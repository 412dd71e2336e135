"""The command line that trains a run again."""

from __future__ import annotations

from collections.abc import Iterator

from zoo_configs.arguments import key_value_words
from zoo_configs.provenance import command_line
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import Run


def repeating_command(run: Run) -> str:
    """
    Return the command line that trains a run again.

    :param run: The run
    :return: The command line
    """
    cell = run.cell
    words = ["bulletarm-zoo", "train", "--env", cell.env_id, "--seed", str(run.seed)]
    if cell.baseline is None:
        words += ["--conf-file", str(run.resolved_file), "--algo", cell.algo]
    else:
        words += ["--baseline", cell.baseline, "--preset", str(cell.preset)]
        words += ["--benchmark", cell.benchmark] if cell.benchmark else []
    words += [] if run.device == "auto" else ["--device", run.device]
    words += ["--gym-packages", ",".join(run.gym_packages)] if run.gym_packages else []
    words += _options(run)
    env_kwargs = cell.overrides.get("env_kwargs", {})
    others = {name: value for name, value in cell.overrides.items() if name != "env_kwargs"}
    words += ["--env-kwargs", *key_value_words(env_kwargs)] if env_kwargs else []
    words += ["-params", *key_value_words(others)] if others else []
    return command_line(words)


def _options(run: Run) -> Iterator[str]:
    """Options that differ from the preset's."""
    preset = TrainingOptions.of(run.cell).plain()
    for name, value in run.options.plain().items():
        if value != preset[name]:
            yield f"--{name.replace('_', '-')}"
            yield from () if value is True else (str(value),)
