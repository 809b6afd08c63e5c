"""The lease of a launch: an object with the launch that runs a sweep, and its last sign of life.

With two launches, the first creates ``launch.json`` and the second is refused, if the store has exclusive
creation (S3, Google, Azure). The lease of a dead launch is free after ``SILENT_SECONDS``, by the machines'
clocks. So is a lease from a clock that is ahead by more; the clocks must agree to within a minute. If two
launches run nevertheless, one of them sees the other's name within ``BEAT_SECONDS`` and stops. Until then
they may repeat work, but do no damage: each attempt writes below its own name.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import StorageError, SweepBusyError
from recrl.orchestrator.process_scope import has_ended, process_scope
from recrl.orchestrator.remote.object_store import ObjectStore

LEASE_CHECK_SECONDS = 5.0  # between two checks for a stop request
BEAT_SECONDS = 15.0  # between two signs of life of a launch
EMPTY_SECONDS = 1.0  # time after which a write has become visible
SILENT_SECONDS = 90.0  # without a sign of life, after which its sweep is free

LAUNCH = "launch.json"
STOP_REQUEST = "stop.request"

logger = logging.getLogger("recrl.sweep")


class LaunchLease:
    """Lease on a sweep in an object store."""

    def __init__(self, objects: ObjectStore) -> None:
        """Prepare the lease without holding it.

        Args:
            objects: of the sweep's folder.
        """
        self._objects = objects
        self._token = ""  # the launch of this process, if any

    @contextmanager
    def held(self, stop: threading.Event) -> Iterator[None]:
        """Hold the lease; set ``stop`` on a request or when another launch has taken over.

        Raises:
            SweepBusyError: another launch holds it.
            StorageError: the store cannot be read or written.
        """
        own = {
            "token": secrets.token_hex(8),
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "boot": process_scope(),
        }
        self._take(own)
        self._token = str(own["token"])
        try:
            self._objects.delete([STOP_REQUEST])
            with background_thread(partial(self._hold, own, stop), name="launch"):
                yield
        finally:
            try:
                if self._holder().get("token") == own["token"]:
                    self._objects.delete([STOP_REQUEST, LAUNCH])
            except StorageError as error:
                logger.warning("%s; the sweep is free again in %.0f seconds", error, SILENT_SECONDS)

    def belongs_to_another(self) -> bool:
        """Return whether another launch runs the sweep now.

        Raises:
            StorageError: the store cannot be read.
        """
        holder = self._holder()
        return _is_alive(holder) and holder.get("token") != self._token

    def request_stop(self) -> None:
        """Ask the launch that runs the sweep, on any machine, to save its trials and end.

        Raises:
            StorageError: the store cannot be written.
        """
        self._objects.write(STOP_REQUEST, b"stop\n")

    def is_held(self) -> bool:
        """Whether a launch runs the sweep, on any machine.

        Raises:
            StorageError: the store cannot be read.
        """
        return _is_alive(self._holder())

    def _take(self, own: dict[str, Any]) -> None:
        """Create ``launch.json``, replacing that of a dead launch."""
        if self._is_created(own):
            return
        holder = self._holder()
        if not holder:  # its content is about to be written, or never will be
            time.sleep(EMPTY_SECONDS)
            holder = self._holder()
        if holder.get("token") == own["token"]:
            return  # it was written, though the answer was lost
        if _is_alive(holder):
            silent = max(0.0, time.time() - holder["at"])
            raise SweepBusyError(
                f"{self._objects.uri}: this sweep is already being run by process {holder['pid']} "
                f"on {holder['host']}, whose last sign of life was {silent:.0f} seconds ago; wait "
                "for it or stop it (if it was killed, the sweep is free after "
                f"{SILENT_SECONDS:.0f} seconds of silence)"
            )
        self._objects.delete([LAUNCH])
        if not self._is_created(own):
            raise SweepBusyError(f"{self._objects.uri}: another process has begun to run this sweep just now")

    def _is_created(self, own: dict[str, Any]) -> bool:
        """Create ``launch.json`` and read it back: not every store can create exclusively."""
        created = self._objects.create(LAUNCH, _beat(own))
        return created and self._holder().get("token") == own["token"]

    def _hold(self, own: dict[str, Any], stop: threading.Event, over: threading.Event) -> None:
        """Write signs of life, and check for requests."""
        renewed_at = time.monotonic()
        while not over.wait(LEASE_CHECK_SECONDS):
            try:
                if self._objects.read(STOP_REQUEST) is not None:
                    stop.set()
                if time.monotonic() >= renewed_at + BEAT_SECONDS:
                    holder = self._holder()
                    if holder and holder.get("token") != own["token"]:
                        logger.warning("%s: another launch has taken over the sweep", self._objects.uri)
                        stop.set()
                        return
                    self._objects.write(LAUNCH, _beat(own))
                    renewed_at = time.monotonic()
            except StorageError as error:  # pulling reports the error
                logger.debug("%s", error)

    def _holder(self) -> dict[str, Any]:
        """Return the holder of the lease; empty if there is none."""
        try:
            value = json.loads(self._objects.read(LAUNCH) or b"{}")
        except ValueError:
            return {}
        return value if isinstance(value, dict) else {}


def _beat(own: dict[str, Any]) -> bytes:
    return json.dumps({**own, "at": time.time()}).encode()


def _is_alive(holder: dict[str, Any]) -> bool:
    """Whether a recorded launch runs: its sign of life is recent, and it is not known to be dead."""
    try:
        if abs(time.time() - float(holder["at"])) > SILENT_SECONDS:  # also if another clock is ahead
            return False
        return not has_ended(int(holder["pid"]), str(holder["boot"]))
    except (KeyError, TypeError, ValueError):
        return False
