"""Table of the code's size."""

from __future__ import annotations

from zoo_configs.drawing.tables import markdown_table
from zoo_configs.measuring.data_files import CODE
from zoo_configs.pages.markers import Source

HEADS = {
    "files": "files",
    "lines": "lines",
    "functions": "functions",
    "median_body": "median body",
    "p90_body": "90th percentile",
    "longest_body": "longest body",
    "longest_file": "longest file",
}


def code_table(source: Source) -> str:
    """
    Tell how large files and functions are, a row for each package and stand.

    :param source: The data
    :return: Markdown
    """
    rows = source.read("code", CODE)
    rows.sort(key=lambda row: row["package"] == "all")
    packages = dict.fromkeys(row["package"] for row in rows)
    lines = [
        [f"{row['package']}, {row['stand']}", *(f"{float(row[column]):,g}" for column in HEADS)]
        for package in packages
        for row in rows
        if row["package"] == package
    ]
    stands = dict.fromkeys(f"{row['stand']}: commit {row['commit']}, {row['date']}" for row in rows)
    return "\n\n".join(
        [markdown_table(["", *HEADS.values()], lines), f"{'; '.join(stands)} ({source.link('code')})."]
    )
