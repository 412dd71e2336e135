"""What a process has registered, told to the processes that it starts.

A spawned worker imports this package and not the user's module: it finds names and import paths in an
environment variable, and imports what they name when it is asked for.
"""

import json
import os
from contextlib import suppress
from typing import Any

VARIABLE = "BULLETARM_GYM_REGISTERED"


def announce(kind: str, name: str, what: Any) -> None:
    """Tell the processes that are started from now on.

    :param kind: ``"task"``, ``"robot"``, ...
    :param name: by which it is asked for
    :param what: JSON: its import path, or what it is made of
    """
    everything = _everything()
    everything.setdefault(kind, {})[name] = what
    os.environ[VARIABLE] = json.dumps(everything)


def announced(kind: str) -> dict[str, Any]:
    """Return what the process that started this one, or this one, has announced, by names."""
    return dict(_everything().get(kind, {}))


def _everything() -> dict[str, dict[str, Any]]:
    found: Any = None
    with suppress(ValueError):  # of somebody else's
        found = json.loads(os.environ.get(VARIABLE, "{}"))
    return found if isinstance(found, dict) else {}
