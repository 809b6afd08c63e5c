"""Folders for what need not outlive a process, and the end of those that a killed process left behind.

A folder is held by a lock that ends with its process, however that ends: one whose lock is free belongs to
nobody. A process number would not do: they are used again, and containers share folders but not numbers. The
lock is made first and removed last, so that a folder without one is empty.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "recrl-"
LOCK = "recrl-scratch.lock"  # no other folder of ours or of anybody's has such a file
NEW_SECONDS = 60.0  # as long as an empty folder may wait for its lock


@contextmanager
def scratch_folder(parent: str, *, before_removal: Callable[[Path], object] | None = None) -> Iterator[Path]:
    """A new folder that only this user can read, removed at the end; those of dead processes are as well.

    Args:
        parent: the folder to make it in.
        before_removal: called with each folder that is about to be removed: ends what still uses it.
    """
    remove_dead(parent, before_removal)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
    try:
        with (folder / LOCK).open("x") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            try:
                yield folder
            finally:
                _remove(folder, before_removal)
    finally:
        with suppress(OSError):
            folder.rmdir()  # what was interrupted before there was a lock


def remove_dead(parent: str, before_removal: Callable[[Path], object] | None = None) -> None:
    """Remove this user's scratch folders that no process holds any more.

    Args:
        parent: the folder that they are in.
        before_removal: as ``scratch_folder`` has it.
    """
    for lock_path in Path(parent).glob(f"{PREFIX}*/{LOCK}"):
        with suppress(OSError), lock_path.open("r+") as lock:
            if os.fstat(lock.fileno()).st_uid == os.getuid():
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails where its process lives
                if os.fstat(lock.fileno()).st_nlink:  # nobody else was quicker
                    _remove(lock_path.parent, before_removal)
    for folder in Path(parent).glob(f"{PREFIX}*"):  # of processes that were killed between two system calls
        with suppress(OSError):
            found = folder.lstat()
            if found.st_uid == os.getuid() and time.time() - found.st_mtime > NEW_SECONDS:
                folder.rmdir()  # fails unless it is empty


def _remove(folder: Path, before_removal: Callable[[Path], object] | None) -> None:
    """Remove a folder, its lock last; what cannot be removed is left to the next process."""
    if before_removal is not None:
        before_removal(folder)
    for path in folder.iterdir():
        if path.name == LOCK:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    if [path.name for path in folder.iterdir()] == [LOCK]:
        (folder / LOCK).unlink()
        folder.rmdir()
