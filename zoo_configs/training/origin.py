"""Where an agent comes from: what its run says of itself."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Any, NamedTuple

import yaml

from zoo_configs.errors import refused
from zoo_configs.training.repeating import repeating_command
from zoo_configs.training.runs import RUN_KEY, Run

SECONDS_A_MINUTE = 60.0


class Origin(NamedTuple):
    """
    How an agent was trained.

    :param minutes: How long; None if the run does not say
    :param command: Trains it again
    :param commit: It was trained with; empty if the run does not say
    :param date: Of the end of the training
    :param machine: It was trained on
    :param versions: It was trained with
    """

    minutes: float | None
    command: str
    commit: str
    date: str
    machine: str
    versions: Mapping[str, str]


def origin_of(run: Run, commit: str = "") -> Origin:
    """
    What a run says of itself.

    :param run: The run
    :param commit: It was trained with, for runs that do not say it
    :return: How it was trained
    :raises CommandError: if its folder cannot be read
    """
    with refused(f"{run.resolved_file} cannot be read"):
        about: dict[str, Any] = yaml.safe_load(run.resolved_file.read_text(encoding="utf-8"))[RUN_KEY]
    how = run.standing
    return Origin(
        minutes=None if how is None else round(how.seconds / SECONDS_A_MINUTE, 1),
        command=repeating_command(run),
        commit=commit or about.get("commit", ""),
        date=day(time.time() if how is None else how.until or how.since + how.seconds),
        machine=about.get("machine", ""),
        versions=about.get("versions", {}),
    )


def day(seconds: float) -> str:
    """
    A date.

    :param seconds: Since 1970
    :return: Year, month and day, in UTC
    """
    return datetime.fromtimestamp(seconds, timezone.utc).date().isoformat()
