"""Temporary folders of a process, and removal of those left by killed processes.

A process holds a lock in its folder, which ends with the process. A folder with a free lock is unused.
Process ids would not be enough: they are reused, and containers share folders but not ids. The lock is
removed last, so that an interrupted removal can continue later.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "recrl-"  # eight characters follow
LOCK = "recrl-scratch.lock"  # only scratch folders of recrl have such a file
EMPTY_SECONDS = 60.0  # older empty folders are not just being made or removed


@contextmanager
def scratch_folder(
    parent: str, *, prefix: str = PREFIX, before_removal: Callable[[Path], None] | None = None
) -> Iterator[Path]:
    """Make a folder that only this user can read, removed at the end; also remove those of dead processes.

    Args:
        parent: the folder to make it in.
        prefix: beginning of its name. Only folders with this prefix and eight more characters are removed.
        before_removal: called with each folder of a dead process before it is removed.
    """
    remove_dead(parent, prefix=prefix, before_removal=before_removal)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        with (folder / LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not os.fstat(lock.fileno()).st_nlink:
                continue  # another process removed the folder before it was locked
            try:
                yield folder
            finally:
                _remove(folder)
            return


def remove_dead(
    parent: str, *, prefix: str = PREFIX, before_removal: Callable[[Path], None] | None = None
) -> None:
    """Remove this user's scratch folders without a running process; arguments as for ``scratch_folder``."""
    made_here = re.compile(re.escape(prefix) + "[a-z0-9_]{8}")  # suffix as in tempfile
    for folder in Path(parent).glob(f"{prefix}*"):
        with suppress(OSError):
            status = folder.stat()
            if not made_here.fullmatch(folder.name) or status.st_uid != os.getuid():
                continue
            if (folder / LOCK).exists():
                _remove_unlocked(folder, before_removal)
            elif time.time() - status.st_mtime > EMPTY_SECONDS:
                folder.rmdir()  # its process died before it made the lock, or after; fails unless it is empty


def _remove_unlocked(folder: Path, before_removal: Callable[[Path], None] | None) -> None:
    """Remove a scratch folder, unless a process holds its lock."""
    with (folder / LOCK).open("r+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails where its process lives
        if os.fstat(lock.fileno()).st_nlink:  # no other process was faster
            if before_removal is not None:
                before_removal(folder)
            _remove(folder)


def _remove(folder: Path) -> None:
    """Remove a scratch folder, its lock last; files that cannot be removed stay."""
    for path in folder.iterdir():
        if path.name == LOCK:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()
    with suppress(OSError):
        (folder / LOCK).unlink()
        folder.rmdir()
