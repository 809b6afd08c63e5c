"""SIGTERM to a worker process of Ray, for example because its node is taken away."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def noticing_sigterm() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether this process got SIGTERM; then the body ends with SystemExit.

    The first signal interrupts the body with a SystemExit, as Ray's own handler does: ``ray.get`` passes on
    this and KeyboardInterrupt only. A user's code may raise a SystemExit as well, or catch this one.

    Raises:
        SystemExit: after SIGTERM, whatever the body did with the interruption.
    """
    signals: list[int] = []

    def end_process(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        if len(signals) == 1:
            raise SystemExit(1)

    before = signal.signal(signal.SIGTERM, end_process)
    try:
        yield lambda: bool(signals)
    finally:
        signal.signal(signal.SIGTERM, before)
        if signals:
            raise SystemExit(1)
