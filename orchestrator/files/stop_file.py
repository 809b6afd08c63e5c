"""Signals by which one run of a sweep makes its workers save and stop: a file or a similar object."""

from __future__ import annotations

import secrets
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class StopSignal(ABC):
    """How one run of a sweep tells its workers, on any node, to save and stop.

    Attributes:
        place: by which workers find it: see ``SweepPlace.stop_signal_at``.
        uri: the address of the sweep in an object store, or empty.
        poll_seconds: least time between two reads of a worker.
    """

    uri = ""
    poll_seconds = 0.5

    def __init__(self, place: str) -> None:
        self.place = place
        self._answer = False
        self._asked_at = float("-inf")

    @abstractmethod
    def set(self) -> None:
        """Tell the workers to stop."""

    def is_set(self) -> bool:
        """Return whether to stop; cheap, because it reads only every ``poll_seconds``."""
        if not self._answer and time.monotonic() >= self._asked_at + self.poll_seconds:
            self._asked_at = time.monotonic()
            self._answer = self._read()
        return self._answer

    @abstractmethod
    def _read(self) -> bool:
        """Return whether the signal is set now."""


class StopFile(StopSignal):
    """Stop signal in the sweep's folder.

    Workers continue as long as the file is empty; they stop when it has content or is missing. It exists from
    the beginning, because a network file system may cache the absence of a file for a minute. Opening a file
    asks the server.

    Attributes:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.path = path

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
        try:
            self.path.write_text("stop\n")
        except OSError:  # no room on the disk; a missing file means stop, too
            self.path.unlink(missing_ok=True)

    def _read(self) -> bool:
        try:
            return bool(self.path.read_bytes())
        except FileNotFoundError:
            return True
        except OSError:  # the disk may come back; the next commit will say so if it does not
            return False
