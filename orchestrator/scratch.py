"""Folders for what need not outlive a process, and the end of those that a killed process left behind.

A folder is held by a lock that ends with its process, however that ends: one whose lock is free belongs to
nobody. A process number would not do: they are used again, and containers share folders but not numbers.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "recrl-"
LOCK = "recrl-scratch.lock"  # no other folder of ours or of anybody's has such a file


@contextmanager
def scratch_folder(parent: str) -> Iterator[Path]:
    """A new folder that only this user can read, removed at the end; those of dead processes are as well.

    Args:
        parent: the folder to make it in.
    """
    remove_dead(parent)
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=parent, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        with (folder / LOCK).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder


def remove_dead(parent: str) -> None:
    """Remove this user's scratch folders that no process holds any more."""
    for lock_path in Path(parent).glob(f"{PREFIX}*/{LOCK}"):
        with suppress(OSError), lock_path.open("r+") as lock:
            if os.fstat(lock.fileno()).st_uid == os.getuid():
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails where its process lives
                if os.fstat(lock.fileno()).st_nlink:  # nobody else was quicker
                    shutil.rmtree(lock_path.parent, ignore_errors=True)
