"""Work in a thread beside a block of code, for as long as the block takes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def beside(work: Callable[[threading.Event], object], *, name: str) -> Iterator[None]:
    """Do something in a thread of its own until the end of the ``with`` block, which waits for it.

    Args:
        work: told by the event that the block is over, however that ended; to return soon after. It may
            return before.
        name: the thread's.
    """
    over = threading.Event()
    thread = threading.Thread(target=work, args=(over,), name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
