"""Undo the changes of Ray and Tune to this process: its environment and its signal handlers."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables until the end of the context; then undo all changes, also Ray's."""
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:  # variable by variable, because other threads read the environment
        for name in os.environ.keys() - before.keys():
            os.environ.pop(name, None)
        for name, value in before.items():
            if os.environ.get(name) != value:
                os.environ[name] = value


@contextmanager
def own_signal_handlers() -> Iterator[None]:
    """Undo the changes of Ray and Tune to this process's signal handlers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGUSR1)}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # None for a handler that was not installed from Python
                signal.signal(number, handler)
