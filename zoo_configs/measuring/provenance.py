"""Where a measurement comes from: machine, date, commit, command."""

from __future__ import annotations

import datetime
import functools
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from zoo_configs.measuring.machine import describe_hardware

PROVENANCE = ("machine", "date", "commit", "command")
DISTRIBUTION = "bulletarm-gym"
DIGITS = 7  # of a commit
HERE = Path(__file__).resolve()
GIT_SECONDS = 10.0


def provenance(command: Sequence[str], device: str = "cpu") -> dict[str, str]:
    """
    Tell where a measurement comes from that is made now.

    :param command: Words of the command that repeats it
    :param device: PyTorch device that it is made on
    :return: A value for each of ``PROVENANCE``
    """
    today = datetime.date.today().isoformat()
    values = (describe_hardware(device), today, commit(), command_line(command))
    return dict(zip(PROVENANCE, values, strict=True))


@functools.cache
def commit() -> str:
    """
    Tell which code this process runs, as it stood when first asked.

    :return: Abbreviated commit of the checkout, with ``-dirty`` where tracked files differ from it; outside a
        checkout the package's version
    """
    words = ("describe", "--always", f"--abbrev={DIGITS}", "--dirty", "--exclude=*")
    if _git("ls-files", "--error-unmatch", HERE.name) is not None and (found := _git(*words)):
        return found
    return f"version {metadata.version(DISTRIBUTION)}"


def _git(*words: str) -> str | None:
    """What git prints about the folder of this file, None where there is no git or no checkout."""
    command = ["git", "-C", str(HERE.parent), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_SECONDS, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def command_line(words: Sequence[str]) -> str:
    """
    Join words for a shell, as a person would type them: text within double quotes, as in ``"robot:'panda'"``.

    :param words: The words
    :return: What to type
    """
    return " ".join(map(_quoted, words))


def _quoted(word: str) -> str:
    return f'"{word}"' if "'" in word and not set(word) & set('"$`\\!') else shlex.quote(word)


def key_values(values: Mapping[str, Any]) -> list[str]:
    """
    Write parameters as the command line takes them.

    :param values: From name to value
    :return: A word each, ``name:value``, sorted: however they were given, they read the same
    """
    return [f"{name}:{value!r}" for name, value in sorted(values.items())]


def env_kwargs_words(env_kwargs: Mapping[str, Any]) -> list[str]:
    """
    Write an environment's parameters as a flag.

    :param env_kwargs: The parameters
    :return: ``--env-kwargs`` and a word each; nothing where there are none
    """
    return ["--env-kwargs", *key_values(env_kwargs)] if env_kwargs else []
