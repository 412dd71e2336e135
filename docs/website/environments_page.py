"""What docs/environments.md tells, for the pages of the tasks."""

import re
from functools import cache

from website.measured import ROOT

PAGE = "environments.md"
SECTIONS = {"close_loop": "Close loop", "open_loop": "Open loop"}
ROW = re.compile(r"^\| `(\w+)` \| `Box\(.*?\)`.*? \| (.*) \|$", re.MULTILINE)
ANCHOR = re.compile(r"\]\(#")


@cache
def observed(control: str) -> dict[str, str]:
    """Return what each part of an observation means, by its name.

    :param control: whose section counts; what it does not tell is taken from the section on sensors
    """
    text = (ROOT / "docs" / PAGE).read_text(encoding="utf-8")
    told = {**_rows(text, "Sensors"), **_rows(text, SECTIONS[control])}
    return {name: ANCHOR.sub(f"](../{PAGE}#", meaning) for name, meaning in told.items()}


def _rows(text: str, section: str) -> dict[str, str]:
    own = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    return dict(ROW.findall(own))
