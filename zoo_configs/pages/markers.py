"""Places of a Markdown page that data fill: between ``<!-- data: NAME -->`` and ``<!-- end of data -->``."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from zoo_configs.errors import CommandError, refused, unknown_name
from zoo_configs.files import whole_file
from zoo_configs.measuring.data_files import DataFile, Layout, Record

PAGES = "*.md"
BEGINS = r"(?<!`)<!-- data: "  # what is told of in backticks is none
BEGINNING = re.compile(BEGINS)
PLACE = re.compile(rf"({BEGINS}(?P<name>[^>]*?) -->).*?(<!-- end of data -->)", re.DOTALL)


@dataclass(frozen=True)
class Source:
    """
    The files of measurements, as a page sees them.

    :param folder: Where they are
    :param page: The page
    """

    folder: Path
    page: Path

    def read(self, name: str, layout: Layout) -> list[Record]:
        """
        Read a file.

        :param name: Its name, without ``.csv``
        :param layout: What stands in it
        :return: Its rows
        :raises CommandError: if it is not there, or has other columns
        """
        path = self._path(name)
        if not path.is_file():
            raise CommandError(f"--data: there is no {path}, which {self.page} asks for")
        return DataFile(path, layout).read("--data")

    def link(self, name: str) -> str:
        """
        Link to a file.

        :param name: Its name, without ``.csv``
        :return: Markdown
        """
        return f"[{name}.csv]({Path(os.path.relpath(self._path(name), self.page.parent)).as_posix()})"

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.csv"


Figure = Callable[[Source], str]


def pages_of(paths: Iterable[Path]) -> list[Path]:
    """
    Find pages.

    :param paths: Markdown files, or folders of them
    :return: The files
    :raises CommandError: if one is neither
    """
    pages: list[Path] = []
    for path in paths:
        if path.is_dir():
            pages += sorted(path.rglob(PAGES))
        elif path.is_file() and path.match(PAGES):
            pages.append(path)
        else:
            raise CommandError(f"--docs takes Markdown files and folders of them, got {path}")
    return pages


def filled(page: Path, folder: Path, figures: Mapping[str, Figure]) -> str:
    """
    Fill a page's places anew.

    :param page: The page
    :param folder: Where the data are
    :param figures: From the name of a place to what fills it
    :return: Its text
    :raises CommandError: for a name that does not exist, or data that are not there
    """
    source = Source(folder, page)

    def fill(place: re.Match[str]) -> str:
        name = place["name"]
        if name not in figures:
            raise unknown_name("place for data", name, figures, see=f"in {page}")
        text = figures[name](source)
        around = "\n\n" if "\n" in text else ""  # a table stands apart, a sentence within its paragraph
        return f"{place[1]}{around}{text}{around}{place[3]}"

    with refused(f"{page} cannot be read", UnicodeDecodeError):
        text = page.read_text(encoding="utf-8")
    if len(BEGINNING.findall(text)) != len(PLACE.findall(text)):
        raise CommandError(f"--docs: a place for data in {page} has no <!-- end of data -->")
    return PLACE.sub(fill, text)


def fill_pages(pages: Iterable[Path], folder: Path, figures: Mapping[str, Figure]) -> list[Path]:
    """
    Fill the places of pages anew. Nothing is written unless all can be filled.

    :param pages: The pages
    :param folder: Where the data are
    :param figures: From the name of a place to what fills it
    :return: Those that have changed
    :raises CommandError: for a name that does not exist, or data that are not there
    """
    texts = {page: filled(page, folder, figures) for page in pages}
    changed = [page for page, text in texts.items() if text != page.read_text(encoding="utf-8")]
    for page in changed:
        with whole_file(page) as partial:
            partial.write_text(texts[page], encoding="utf-8")
    return changed


def origins(rows: Sequence[Record]) -> str:
    """
    Tell where rows come from.

    :param rows: Of a file
    :return: Machines, dates and commits, each once
    """
    return "; ".join(
        dict.fromkeys(f"{row['machine']}, {row['date']}, commit {row['commit']}" for row in rows)
    )
