"""An object by which one run of a sweep signals its workers to save and stop."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Iterator
from contextlib import contextmanager

from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.stop_file import StopSignal
from recrl.orchestrator.remote.object_store import ObjectStore

logger = logging.getLogger("recrl.sweep")


class StopObject(StopSignal):
    """Stop signal in the object store; its place is the object's key, relative to the sweep's address."""

    poll_seconds = 5.0

    def __init__(self, objects: ObjectStore, key: str) -> None:
        super().__init__(key)
        self._objects = objects
        self.uri = objects.uri

    @classmethod
    @contextmanager
    def open(cls, objects: ObjectStore) -> Iterator[StopObject]:
        """Make the stop object of a new run; workers of earlier runs are stopped.

        Raises:
            StorageError: the store cannot be written.
        """
        objects.delete(key for key in objects.names("file") if key.startswith("stop-"))
        signal = cls(objects, f"stop-{secrets.token_hex(4)}")
        objects.write(signal.place, b"go on\n")
        try:
            yield signal
        finally:
            try:
                objects.delete([signal.place])
            except StorageError as error:
                logger.warning("%s", error)

    def set(self) -> None:
        """Signal the workers to stop; after an error the caller calls again."""
        if self._answer:
            return
        try:
            self._objects.write(self.place, b"stop\n")
            self._answer = True
        except StorageError as error:
            logger.debug("%s", error)

    def _read(self) -> bool:
        """Read the object; no answer means no."""
        try:
            return self._objects.read(self.place) != b"go on\n"
        except StorageError as error:
            logger.debug("%s", error)
            return False
