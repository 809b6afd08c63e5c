"""A file by which one run of a sweep tells its workers to save and stop."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STOP_QUESTION_SECONDS = 0.5


class StopFile:
    """How one run of a sweep tells its workers, on any node, to checkpoint and stop.

    The file is empty as long as they are to go on; they stop when it says anything, or is gone. It is there
    from the beginning because a network file system may remember for a minute that a file is absent,
    whereas opening one asks the server.

    Attributes:
        path: the file, in the sweep's folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._answer = False
        self._asked_at = float("-inf")

    uri = ""  # it is in no object store

    @property
    def place(self) -> str:
        """By which workers find it."""
        return str(self.path)

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator[StopFile]:
        """The stop file of a new run; whatever may be left of earlier runs is told to stop."""
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("stop-*"):
            old.unlink(missing_ok=True)
        stop_file = cls(folder / f"stop-{secrets.token_hex(4)}")
        stop_file.path.touch()
        try:
            yield stop_file
        finally:
            stop_file.path.unlink(missing_ok=True)

    def set(self) -> None:
        """Tell the workers to stop."""
        self.path.write_text("stop\n")

    def is_set(self) -> bool:
        """Whether to stop; looks at the file every ``STOP_QUESTION_SECONDS`` at most."""
        if not self._answer and time.monotonic() >= self._asked_at + STOP_QUESTION_SECONDS:
            self._asked_at = time.monotonic()
            try:
                self._answer = bool(self.path.read_bytes())
            except FileNotFoundError:
                self._answer = True
        return self._answer
