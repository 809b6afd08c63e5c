"""Lock files, opened without following symbolic links.

Folders of results are shared and copied. If the lock were a symbolic link, truncating the lock would empty
the file that it points to. A process that a user's code forks inherits open files, and with them their locks.
So a lock is released explicitly, and a forked process lets go of it.
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
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # of a file system

_open: set[int] = set()  # descriptors of this process's locks


@contextmanager
def opened_lock(path: Path) -> Iterator[IO[str]]:
    """Open a lock for reading and writing, at its end; create it if it is missing, and release it at the end.

    Raises:
        StorageError: it is a link, a folder or another non-file.
    """
    with os.fdopen(_opened(path, os.O_RDWR | os.O_CREAT | os.O_APPEND), "a+") as file:
        _open.add(file.fileno())
        try:
            yield file
        finally:
            _open.discard(file.fileno())
            flock(file, fcntl.LOCK_UN)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock alone; waits for it.

    Raises:
        StorageError: it is a link, a folder or another special file, or the file system has no locks.
    """
    with opened_lock(path) as file:
        flock(file, fcntl.LOCK_EX)
        yield


def flock(file: IO[str], how: int) -> None:
    """Take or release a lock by ``fcntl.flock``.

    Raises:
        BlockingIOError: another process holds it, and ``how`` does not wait.
        StorageError: the file system has no locks.
    """
    try:
        fcntl.flock(file, how)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        raise StorageError(
            "the file system of the results has no locks (Lustre and NFS can be mounted with them); "
            "keep the sweep elsewhere, by --root or --storage"
        ) from error


def _let_go() -> None:
    """Let go of the locks of the parent, in a forked process; the descriptors stay open, but for nothing."""
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in _open:
        os.dup2(null, descriptor, inheritable=False)
    os.close(null)
    _open.clear()


os.register_at_fork(after_in_child=_let_go)


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
