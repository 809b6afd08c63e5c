"""Run a function in a background thread during a block of code."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import copy_context


@contextmanager
def background_thread(work: Callable[[threading.Event], object], *, name: str) -> Iterator[None]:
    """Run a function in a thread until the end of the ``with`` block, which waits for it.

    The thread refuses import paths if the block does.

    Args:
        work: the function. Its event is set when the block ends, also by an error; then it must return soon.
            It may return earlier.
        name: of the thread.
    """
    over = threading.Event()
    thread = threading.Thread(target=copy_context().run, args=(work, over), name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
