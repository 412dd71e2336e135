"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from zoo_configs.errors import CommandError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """
    Give a temporary path beside ``path``; if the block succeeds it takes the place of ``path``, else it goes.

    :param path: The file to be; its folder is created
    :return: Context manager of the path to write to, with the same suffix
    """
    made = missing_folders(path.parent)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o666 & ~_umask())
        os.replace(partial, path)
    except OSError as error:
        error.filename = error.filename or str(path)  # a full disk does not say whose
        raise
    finally:
        partial.unlink(missing_ok=True)
        remove_empty(made)


def check_writable(path: Path, name: str) -> None:
    """
    Ask whether a file can be written, before the work that fills it begins. Leaves nothing.

    :param path: The file to be; its folder need not be there yet
    :param name: Which argument it comes from
    :raises CommandError: if it cannot, with the reason
    """
    if path.is_dir():
        raise CommandError(f"{name}: {path} is a folder, it takes a file")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise CommandError(f"{name}: {path} cannot be written: {error.strerror}") from error


def missing_folders(path: Path) -> list[Path]:
    """
    Folders that would have to be made for a path.

    :param path: A folder
    :return: It and its parents that are not there, innermost first
    """
    return [folder for folder in (path, *path.parents) if not folder.exists()]


def remove_empty(folders: Iterable[Path]) -> None:
    """
    Remove folders as far as there is nothing in them.

    :param folders: Each stands in the next
    """
    with contextlib.suppress(OSError):  # not empty: those around it are not, either
        for folder in folders:
            folder.rmdir()


def _umask() -> int:
    """The process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
