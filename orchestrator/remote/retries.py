"""Wait for an object store that is down."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from recrl.orchestrator.errors import DamagedError, StorageError

FIRST_PAUSE_SECONDS = 1.0  # before the first repetition; doubled each time
LONGEST_PAUSE_SECONDS = 60.0
RETRY_SECONDS = 900.0  # for a store that is down when a trial begins or has ended
STOPPING_SECONDS = 60.0  # the same, once the sweep is stopping

logger = logging.getLogger("recrl.trial")


def retry_while_down(act: Callable[[], None], should_stop: Callable[[], bool]) -> None:
    """Repeat an action while the store is down, with growing pauses.

    Args:
        act: the action; may be repeated.
        should_stop: once true, only for ``STOPPING_SECONDS`` more.

    Raises:
        DamagedError: a file or an object is damaged; waiting does not help.
        StorageError: it was down for ``RETRY_SECONDS``.
    """
    began = time.monotonic()
    pause, stopping_since = FIRST_PAUSE_SECONDS, float("inf")
    while True:
        try:
            return act()
        except DamagedError:
            raise
        except StorageError as error:
            now = time.monotonic()
            if should_stop():
                stopping_since = min(stopping_since, now)
            left = min(began + RETRY_SECONDS, stopping_since + STOPPING_SECONDS) - now
            if left <= 0.0:
                raise
            if pause == FIRST_PAUSE_SECONDS:
                logger.warning("%s; it is tried again for %.0f minutes", error, left / 60.0)
            time.sleep(min(pause, left))
            pause = min(2.0 * pause, LONGEST_PAUSE_SECONDS)


def repeat_until(act: Callable[[], None], over: threading.Event, *, every: float, hint: str) -> None:
    """Do what needs the store again and again until it is over; less often while the store is down.

    Args:
        act: what to do.
        over: ends it.
        every: seconds between two times.
        hint: what is said once of a store that is down.
    """
    pause = every
    while not over.wait(pause):
        try:
            act()
        except (StorageError, OSError) as error:
            if pause == every:
                logger.warning("%s; %s", error, hint)
            pause = min(2.0 * max(pause, FIRST_PAUSE_SECONDS / 2.0), LONGEST_PAUSE_SECONDS)
        else:
            if pause > every:
                logger.info("the storage answers again")
            pause = every
