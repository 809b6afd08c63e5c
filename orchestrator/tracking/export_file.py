"""The sweep's export file among the artifacts of its parent run: what others read a sweep from.

The file is what ``recrl-sweep export`` writes (``recrl.analysis.data.export``). This package does not import
the analysis: whoever syncs hands in a function that writes the file.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.tracking.positions import Position
from recrl.orchestrator.tracking.runs import SweepRuns

FOLDER = "export"
FILE_NAME = "sweep.zip"
UPLOADED_TAG = "recrl.export_uploaded"  # of the parent run: the sweep's state as of when, in UTC
INTERVAL_SECONDS = 600.0  # between two uploads while the sweep runs, at least
REST = 100.0  # times as long as the last upload took

now = time.monotonic
ExportWriter = Callable[[SweepStore, Path], object]


class ExportUpload:
    """Uploads the export file at the end of a sweep, and now and then before."""

    def __init__(self, store: SweepStore, runs: SweepRuns, write: ExportWriter, folder: Path) -> None:
        """Wait one interval before the first upload of a sweep that runs.

        Args:
            store: the sweep.
            runs: its runs.
            write: writes the export file of a sweep.
            folder: where the file lies until it is sent.
        """
        self._store = store
        self._runs = runs
        self._write = write
        self._path = folder / FILE_NAME
        self._due = now() + INTERVAL_SECONDS

    def bring_up_to_date(
        self, parent: Position, records: dict[str, TrialRecord], *, live: bool
    ) -> tuple[Position, str]:
        """Upload the file if the sweep changed and, while a launch runs, the time has come.

        Args:
            parent: position of the parent run.
            records: of all trials, by folder name.
            live: whether a launch runs.

        Returns:
            The new position, and why the file could not be uploaded, or nothing.
        """
        mark = _mark(records)
        if not records or parent.shown.get("export") == mark or (live and now() < self._due):
            return parent, ""
        began = now()
        try:
            self._upload()
        except Exception as error:  # a server may take small files only; the runs are shown all the same
            return parent, next(iter(str(error).splitlines()), type(error).__name__)
        finally:
            ended = now()
            self._due = ended + max(INTERVAL_SECONDS, REST * (ended - began))
        return replace(parent, shown={**parent.shown, "export": mark}), ""

    def _upload(self) -> None:
        at = time.strftime("%F %T", time.gmtime())
        try:
            self._write(self._store, self._path)
            self._runs.client.log_artifact(self._runs.parent_id, str(self._path), FOLDER)
        finally:
            self._path.unlink(missing_ok=True)
        self._runs.client.set_tag(self._runs.parent_id, UPLOADED_TAG, at)


def write_in_own_process(store: SweepStore, path: Path) -> None:
    """Write a sweep's export file in a process of its own, so that this one needs no pandas and stays small.

    Raises:
        TrackingError: the file could not be written.
    """
    command = [sys.executable, "-m", "recrl", "export", store.name]
    done = subprocess.run(
        [*command, "--root", str(store.folder.parent), "--to", str(path)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        lines: Sequence[str] = done.stderr.strip().splitlines() or ["it says nothing"]
        raise TrackingError(f"recrl-sweep export failed: {lines[-1]}")


def _mark(records: dict[str, TrialRecord]) -> str:
    """Return what changes whenever a trial begins, commits or ends."""
    known = [
        (name, str(record.status), record.attempt, sorted(record.committed.items()))
        for name, record in sorted(records.items())
    ]
    return hashlib.sha256(repr(known).encode()).hexdigest()
