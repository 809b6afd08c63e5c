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
from types import TracebackType

from recrl.orchestrator.errors import LostLeaseError, StorageError

LEAST_WORK_SECONDS = 1e-3  # CPU time between two beats; what only looks for signals uses less

logger = logging.getLogger("recrl.trial")


class Heartbeat:
    """Beats beside the thread that enters this context, while that one works.

    Args:
        beat: says that the trial lives; may raise LostLeaseError.
        seconds: between two beats, above 0.
    """

    def __init__(self, beat: Callable[[], None], *, seconds: float) -> None:
        self._beat = beat
        self._seconds = seconds
        self._over = threading.Event()
        self._lost: LostLeaseError | None = None
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def __enter__(self) -> Heartbeat:
        self._clock = time.pthread_getcpuclockid(threading.get_ident())
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def check(self) -> None:
        """Raise LostLeaseError if a beat met it: another attempt runs the trial."""
        if self._lost is not None:
            raise self._lost

    def _run(self) -> None:
        worked = time.clock_gettime(self._clock)
        while not self._over.wait(self._seconds):
            now = time.clock_gettime(self._clock)
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
