"""How an agent was trained, from its run folder."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from typing import Any, NamedTuple

from zoo_configs.arguments import key_value_words
from zoo_configs.errors import refused
from zoo_configs.provenance import command_line
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import RUN_KEY, Run
from zoo_configs.yaml_files import read_yaml

SECONDS_A_MINUTE = 60.0


class Origin(NamedTuple):
    """
    How an agent was trained.

    :param minutes: Training time, None if unknown
    :param command: Command line that trains it again
    :param commit: Commit of the code, empty if unknown
    :param date: Date of the end of the training
    :param machine: Processor and GPU
    :param versions: Versions of packages
    """

    minutes: float | None
    command: str
    commit: str
    date: str
    machine: str
    versions: Mapping[str, str]


def origin_of(run: Run, commit: str = "") -> Origin:
    """
    Read how a run was trained.

    :param run: The run
    :param commit: Commit of the code, for runs that do not record it
    :return: How it was trained
    :raises CommandError: if its folder cannot be read
    """
    with refused(f"{run.resolved_file} cannot be read"):
        about: dict[str, Any] = read_yaml(run.resolved_file)[RUN_KEY]
    how = run.status
    return Origin(
        minutes=None if how is None else round(how.seconds / SECONDS_A_MINUTE, 1),
        command=repeating_command(run),
        commit=commit or about.get("commit", ""),
        date=day(time.time() if how is None else how.until or how.since + how.seconds),
        machine=about.get("machine", ""),
        versions=about.get("versions", {}),
    )


def repeating_command(run: Run) -> str:
    """
    Return the command line that trains a run again.

    :param run: The run
    :return: The command line
    """
    experiment = run.experiment
    words = ["bulletarm-zoo", "train", "--env", experiment.env_id, "--seed", str(run.seed)]
    if experiment.baseline is None:
        words += ["--conf-file", str(run.resolved_file), "--algo", experiment.algo]
    else:
        words += ["--baseline", experiment.baseline, "--preset", str(experiment.preset)]
        words += ["--benchmark", experiment.benchmark] if experiment.benchmark else []
    words += [] if run.device == "auto" else ["--device", run.device]
    words += ["--gym-packages", ",".join(run.gym_packages)] if run.gym_packages else []
    words += _options(run)
    env_kwargs = experiment.overrides.get("env_kwargs", {})
    others = {name: value for name, value in experiment.overrides.items() if name != "env_kwargs"}
    words += ["--env-kwargs", *key_value_words(env_kwargs)] if env_kwargs else []
    words += ["-params", *key_value_words(others)] if others else []
    return command_line(words)


def _options(run: Run) -> Iterator[str]:
    """Options that differ from the preset's."""
    preset = TrainingOptions.of(run.experiment).plain()
    for name, value in run.options.plain().items():
        if value != preset[name]:
            yield f"--{name.replace('_', '-')}"
            yield from () if value is True else (str(value),)


def day(seconds: float) -> str:
    """
    Return a date.

    :param seconds: Seconds since 1970
    :return: Year, month and day, in UTC
    """
    return datetime.fromtimestamp(seconds, timezone.utc).date().isoformat()
