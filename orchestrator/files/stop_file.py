"""A file by which one run of a sweep signals its workers to save and stop."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STOP_QUESTION_SECONDS = 0.5


class StopFile:
    """Stop signal of one run of a sweep for its workers on all nodes, as a file.

    Workers continue as long as the file is empty; they stop when it has content or is missing. It exists from
    the beginning, because a network file system may cache the absence of a file for a minute. Opening a file
    asks the server.

    Attributes:
        path: the file, in the sweep's folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._answer = False
        self._asked_at = float("-inf")

    uri = ""  # not in an object store

    @property
    def place(self) -> str:
        """Return the name for the workers."""
        return str(self.path)

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator[StopFile]:
        """Make the stop file of a new run; workers of earlier runs are stopped."""
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
        """Signal the workers to stop."""
        self.path.write_text("stop\n")

    def is_set(self) -> bool:
        """Whether to stop; reads the file every ``STOP_QUESTION_SECONDS`` at most."""
        if not self._answer and time.monotonic() >= self._asked_at + STOP_QUESTION_SECONDS:
            self._asked_at = time.monotonic()
            try:
                self._answer = bool(self.path.read_bytes())
            except FileNotFoundError:
                self._answer = True
        return self._answer
