"""Files that are written atomically."""

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
    Provide a temporary file that replaces ``path`` if the block succeeds, and is removed otherwise.

    :param path: The file to write; its folder is created
    :return: Context manager of the temporary file, which has the same suffix
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
        error.filename = error.filename or str(path)  # the error of a full disk has no file name
        raise
    finally:
        partial.unlink(missing_ok=True)
        remove_empty(made)


def check_writable(path: Path, name: str) -> None:
    """Raise ``CommandError`` if a file cannot be written; ``name`` is the argument that it comes from."""
    if path.is_dir():
        raise CommandError(f"{name} must be a file, got the folder {path}")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise CommandError(f"{name}: {path} cannot be written: {error.strerror}") from error


def print_written(*paths: Path) -> None:
    """Print the files that a command has written."""
    print("\n".join(["Written:", *(f"  {path}" for path in paths)]))


def missing_folders(path: Path) -> list[Path]:
    """Return the folders of a path that do not exist, innermost first."""
    return [folder for folder in (path, *path.parents) if not folder.exists()]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove empty folders, innermost first."""
    with contextlib.suppress(OSError):  # not empty, so neither are its parents
        for folder in folders:
            folder.rmdir()


def _umask() -> int:
    """Return the file mode mask of the process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
