"""Redraw the report of a running sweep at intervals.

Drawing takes seconds of a core. So it is a sketch (``recrl-sweep figures --sketch``), made in a separate
process of the lowest priority. On average it takes at most about a thirtieth of a core. The output is in the
sweep's figures folder, from which the MLflow sync uploads it. A failure is not fatal, as the launch draws
the final, complete report itself; it is logged once.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.redaction import redacted

FIRST_SECONDS = 120.0
INTERVAL_SECONDS = 300.0
REST = 30.0  # multiple of the time of the last drawing
LOWEST_PRIORITY = 19

logger = logging.getLogger("recrl.sweep")


@contextmanager
def refreshing(
    store: SweepStore, *, first_seconds: float = FIRST_SECONDS, interval_seconds: float = INTERVAL_SECONDS
) -> Iterator[None]:
    """Redraw the report at intervals until the end of the ``with`` block.

    Args:
        store: the sweep.
        first_seconds: until the first drawing.
        interval_seconds: least time between two drawings.
    """
    work = partial(_refresh, store, first_seconds, interval_seconds)
    with background_thread(work, name="report"):
        yield


def sketch_command(store: SweepStore) -> list[str]:
    """Return the command that sketches the sweep's report."""
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
    is_logged = False
    while not over.wait(wait):
        if not _has_updates(store):
            wait = interval
            continue
        began = time.monotonic()
        problem = _sketch(store, over)
        if problem and not is_logged:
            is_logged = True
            logger.warning(
                "the report of the running sweep could not be drawn (%s); training goes on, and it is tried "
                "again",
                problem,
            )
        wait = max(interval, REST * (time.monotonic() - began))


def _has_updates(store: SweepStore) -> bool:
    """Whether there is something to draw, and the disk can be read."""
    try:
        return any(trial.record().update for trial in store.trials())
    except StorageError:
        return False


def _sketch(store: SweepStore, over: threading.Event) -> str:
    """Sketch the report; return why that failed, empty if it did not or if ``over`` was set meanwhile."""
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            sketch_command(store),
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
            start_new_session=True,  # Ctrl-C is handled by the launch
        )
        os.setpriority(os.PRIO_PROCESS, process.pid, LOWEST_PRIORITY)
        while process.poll() is None and not over.wait(0.2):
            pass
        if process.poll() is None:
            process.terminate()
            process.wait()
            return ""
        if not process.returncode:
            return ""
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
        return (
            redacted(lines[-1].removeprefix("recrl-sweep: ")) if lines else f"exit code {process.returncode}"
        )
