"""Meanings of observations, from the tables in the documentation, for the pages of the tasks."""

import re
from functools import cache

from website.measured import ROOT

SECTIONS = {
    "close_loop": ("environments.md", "Closed loop { #close-loop }"),
    "open_loop": ("environments.md", "Open loop"),
}
"""Page and heading with the observations of each control."""
SENSORS = ("observations.md", "Sensors")
"""Page and heading with all sensors."""
ROW = re.compile(r"^\| `(\w+)` \| `Box\(.*?\)` \| (.*) \|$", re.MULTILINE)
LINK = re.compile(r"\]\(((?:\w+\.md)?)#")


@cache
def observed(control: str) -> dict[str, str]:
    """Return the meaning of each entry of an observation, by its name.

    :param control: control whose section has precedence over the section on sensors
    """
    return {**_rows(*SENSORS), **_rows(*SECTIONS[control])}


def _rows(page: str, section: str) -> dict[str, str]:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    _, heading, rest = text.partition(f"\n## {section}\n")
    if not heading:
        raise ValueError(f"{page} must have the section {section!r}")
    rows = ROW.findall(rest.partition("\n## ")[0])
    return {name: LINK.sub(lambda link: f"](../{link[1] or page}#", meaning) for name, meaning in rows}
