"""The report of a sweep, drawn again now and then while the sweep runs.

Drawing takes seconds of a core that trials want. So it is a sketch (``recrl-sweep figures --sketch``), made
in a process of its own, of the lowest priority, and seldom enough to take at most about a thirtieth of a
core. What it draws lies in the sweep's figures folder, from which the mirror sends it to MLflow. A report
that cannot be drawn is no failure: the launch draws the last and whole one itself.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from recrl.orchestrator.background import beside
from recrl.orchestrator.files.sweep_store import SweepStore

FIRST_SECONDS = 120.0
INTERVAL_SECONDS = 300.0
REST = 30.0  # times as long as the last drawing took
LOWEST_PRIORITY = 19


@contextmanager
def refreshing(
    store: SweepStore, *, first_seconds: float = FIRST_SECONDS, interval_seconds: float = INTERVAL_SECONDS
) -> Iterator[None]:
    """Draw the report again and again until the end of the ``with`` block.

    Args:
        store: the sweep.
        first_seconds: until the first time.
        interval_seconds: between two times, at least.
    """
    work = partial(_refresh, store, first_seconds, interval_seconds)
    with beside(work, name="report"):
        yield


def sketch_command(store: SweepStore) -> list[str]:
    """The command that sketches the sweep's report."""
    root = ["--root", str(store.folder.parent)]
    return [
        sys.executable,
        "-m",
        "recrl",
        "figures",
        store.name,
        "--sketch",
        "--trust",
        *root,
    ]


def _refresh(store: SweepStore, wait: float, interval: float, over: threading.Event) -> None:
    while not over.wait(wait):
        began = time.monotonic()
        process = subprocess.Popen(
            sketch_command(store),
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the launch
        )
        os.setpriority(os.PRIO_PROCESS, process.pid, LOWEST_PRIORITY)
        while process.poll() is None and not over.wait(0.2):
            pass
        if process.poll() is None:
            process.terminate()
        process.wait()
        wait = max(interval, REST * (time.monotonic() - began))
