"""An object by which one run of a sweep signals its workers to save and stop."""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager

from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.remote.object_store import ObjectStore

STOP_QUESTION_SECONDS = 5.0  # between two reads by a worker

logger = logging.getLogger("recrl.sweep")


class StopObject:
    """Stop signal of one run of a sweep for its workers on all nodes, as an object: see ``stop_file``.

    Attributes:
        key: of the object, below the sweep.
    """

    def __init__(self, objects: ObjectStore, key: str) -> None:
        self._objects = objects
        self.key = key
        self._answer = False
        self._asked_at = float("-inf")

    @property
    def place(self) -> str:
        """Return the name for the workers, relative to the sweep's address."""
        return self.key

    @property
    def uri(self) -> str:
        """The sweep's address."""
        return self._objects.uri

    @classmethod
    @contextmanager
    def open(cls, objects: ObjectStore) -> Iterator[StopObject]:
        """Make the stop object of a new run; workers of earlier runs are stopped.

        Raises:
            StorageError: the store cannot be written.
        """
        objects.delete(key for key in objects.names("file") if key.startswith("stop-"))
        sign = cls(objects, f"stop-{secrets.token_hex(4)}")
        objects.write(sign.key, b"go on\n")
        try:
            yield sign
        finally:
            try:
                objects.delete([sign.key])
            except StorageError as error:
                logger.warning("%s", error)

    def set(self) -> None:
        """Signal the workers to stop; after an error the caller calls again."""
        if self._answer:
            return
        try:
            self._objects.write(self.key, b"stop\n")
            self._answer = True
        except StorageError as error:
            logger.debug("%s", error)

    def is_set(self) -> bool:
        """Whether to stop; reads the object every ``STOP_QUESTION_SECONDS`` at most. No answer means no."""
        if not self._answer and time.monotonic() >= self._asked_at + STOP_QUESTION_SECONDS:
            self._asked_at = time.monotonic()
            try:
                self._answer = self._objects.read(self.key) != b"go on\n"
            except StorageError as error:
                logger.debug("%s", error)
        return self._answer
