"""Lock files, opened without following symbolic links.

Folders of results are shared and copied. If the lock were a symbolic link, truncating the lock would empty
the file that it points to.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from recrl.orchestrator.errors import StorageError

FLAGS = os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK


def open_lock(path: Path) -> IO[str]:
    """Open a lock for reading and writing, at its end; create it if it is missing.

    Raises:
        StorageError: it is a link, a folder or another non-file.
    """
    return os.fdopen(_opened(path, os.O_RDWR | os.O_CREAT | os.O_APPEND), "a+")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock alone; waits for it.

    Raises:
        StorageError: it is a link, a folder or another special file.
    """
    with open_lock(path) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def look_at_lock(path: Path) -> IO[str]:
    """Open a lock for reading.

    Raises:
        FileNotFoundError: it is missing.
        StorageError: it is a link, a folder or another non-file.
    """
    return os.fdopen(_opened(path, os.O_RDONLY), "r")


def _opened(path: Path, flags: int) -> int:
    try:
        descriptor = os.open(path, flags | FLAGS, 0o644)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise
        raise _no_lock(path) from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _no_lock(path)
    return descriptor


def _no_lock(path: Path) -> StorageError:
    return StorageError(f"{path}: is a lock, and must be a file and no link; delete it if nothing runs there")
