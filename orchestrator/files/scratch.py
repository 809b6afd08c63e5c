"""Folders for what need not outlive a process, and the end of those that a killed process left behind.

A folder is held by a lock that ends with its process, however that ends: one whose lock is free belongs to
nobody. A process number would not do: they are used again, and containers share folders but not numbers. The
lock is the last thing in a folder that is removed: whatever interrupts the removal, the next one goes on.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "recrl-"
LOCK = "recrl-scratch.lock"  # no other folder of ours or of anybody's has such a file
EMPTY_SECONDS = 60.0  # after which an empty folder is not just being made, or just being removed
_MADE_HERE = re.compile(re.escape(PREFIX) + "[a-z0-9_]{8}")  # as tempfile names it


@contextmanager
def scratch_folder(parent: str) -> Iterator[Path]:
    """A new folder that only this user can read, removed at the end; those of dead processes are as well.

    Args:
        parent: the folder to make it in.
    """
    remove_dead(parent)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
    with (folder / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            yield folder
        finally:
            _remove(folder)


def remove_dead(parent: str) -> None:
    """Remove this user's scratch folders that no process holds any more."""
    for folder in dead_folders(parent):
        with suppress(OSError):
            _remove(folder)
    for folder in Path(parent).glob(f"{PREFIX}*"):  # its process died before its lock was there, or after
        with suppress(OSError):
            status = folder.stat()
            is_old = time.time() - status.st_mtime > EMPTY_SECONDS
            if _MADE_HERE.fullmatch(folder.name) and status.st_uid == os.getuid() and is_old:
                folder.rmdir()  # fails unless it is empty


def dead_folders(parent: str) -> Iterator[Path]:
    """This user's scratch folders that no process holds any more, each locked until the next is asked for."""
    for lock_path in Path(parent).glob(f"{PREFIX}*/{LOCK}"):
        with suppress(OSError), lock_path.open("r+") as lock:
            if os.fstat(lock.fileno()).st_uid == os.getuid():
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails where its process lives
                if os.fstat(lock.fileno()).st_nlink:  # nobody else was quicker
                    yield lock_path.parent


def _remove(folder: Path) -> None:
    """Remove a scratch folder, its lock last; what cannot be removed stays."""
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
