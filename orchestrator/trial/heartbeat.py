"""Heartbeat of a running trial: a thread that writes signs of life while the trial computes.

A trial computes if its thread uses processor time. So the heartbeat continues during an update of an hour, or
a long evaluation. It stops when a trial waits without end or its process is stopped. An infinite loop cannot
be distinguished from a long computation.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import LostLeaseError, StorageError

LEAST_WORK_SECONDS = 1e-3  # least CPU time between two beats; checking for signals uses less

logger = logging.getLogger("recrl.trial")


class Heartbeat:
    """Writer of signs of life while a thread computes; see ``beating``.

    Args:
        beat: writes a sign of life; may raise LostLeaseError.
        seconds: between two beats, above 0.
    """

    def __init__(self, beat: Callable[[], None], *, seconds: float) -> None:
        self._beat = beat
        self._seconds = seconds
        self._lost: LostLeaseError | None = None

    def beating(self) -> AbstractContextManager[None]:
        """Beat in a second thread until the end of the ``with`` block, while the calling one works."""
        clock = time.pthread_getcpuclockid(threading.get_ident())
        return background_thread(partial(self._run, clock), name="heartbeat")

    def check(self) -> None:
        """Raise LostLeaseError if a beat did: another attempt runs the trial."""
        if self._lost is not None:
            raise self._lost

    def _run(self, clock: int, over: threading.Event) -> None:
        worked = time.clock_gettime(clock)
        while not over.wait(self._seconds):
            now = time.clock_gettime(clock)
            if now - worked < LEAST_WORK_SECONDS:
                continue
            worked = now
            try:
                self._beat()
            except LostLeaseError as error:
                self._lost = error
                return
            except StorageError as error:  # the next commit will raise it as well, and end the trial
                logger.warning("%s", error)
