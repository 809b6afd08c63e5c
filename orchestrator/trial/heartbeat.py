"""The sign of life of a running trial: a thread that speaks for it as long as it works.

A trial works if the thread that runs it uses the processor. So an update of an hour, or a long evaluation,
is heard all the time, while a trial that waits for what never comes, or whose process is stopped, falls
silent. What cannot be told is a loop without end from a long computation.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial

from recrl.orchestrator.background import beside
from recrl.orchestrator.errors import LostLeaseError, StorageError

LEAST_WORK_SECONDS = 1e-3  # CPU time between two beats; what only looks for signals uses less

logger = logging.getLogger("recrl.trial")


class Heartbeat:
    """Beats for one thread while that one works.

    Args:
        beat: says that the trial lives; may raise LostLeaseError.
        seconds: between two beats, above 0.
    """

    def __init__(self, beat: Callable[[], None], *, seconds: float) -> None:
        self._beat = beat
        self._seconds = seconds
        self._lost: LostLeaseError | None = None

    def beating(self) -> AbstractContextManager[None]:
        """Beat beside the thread that calls this, until the end of the ``with`` block."""
        clock = time.pthread_getcpuclockid(threading.get_ident())
        return beside(partial(self._run, clock), name="heartbeat")

    def check(self) -> None:
        """Raise LostLeaseError if a beat met it: another attempt runs the trial."""
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
            except StorageError as error:  # the next commit will meet it too, and end the trial
                logger.warning("%s", error)
