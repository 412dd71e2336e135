"""PyBullet, imported without the line about its build that it prints.

That line would stand before the errors and tables of programs that use an environment.
"""

import ctypes
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["pybullet"]

BANNER = b"pybullet build time:"
STDOUT, STDERR = 1, 2


@contextmanager
def _without_banner(descriptor: int) -> Iterator[None]:
    """Hold back what is written to a file descriptor; afterwards all of it but the banner is written.

    It is done to the descriptor, for C writes past Python's ``sys.stderr``.
    """
    try:
        original = os.dup(descriptor)
    except OSError:  # it is closed, as a daemon's may be
        yield
        return
    with os.fdopen(original, "wb", buffering=0) as stream, tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), descriptor)
        try:
            yield
        finally:
            _flush()
            os.dup2(stream.fileno(), descriptor)
            held.seek(0)
            stream.writelines(line for line in held if not line.startswith(BANNER))


def _flush() -> None:
    """Write what C holds in its buffers: a pipe's or a file's would come out later."""
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)


# Releases differ in the stream that they print to.
with _without_banner(STDOUT), _without_banner(STDERR):
    import pybullet
