"""The sweep's export file among the artifacts of its parent run, for reading a sweep from MLflow.

The file is that of ``recrl-sweep export`` (``recrl.analysis.data.export``). This package does not import the
analysis: the caller passes a function that writes the file.
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

from recrl.orchestrator.errors import TrackingError, first_line
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.tracking.mlflow_runs import SweepRuns
from recrl.orchestrator.tracking.positions import Position

FOLDER = "export"
FILE_NAME = "sweep.zip"
UPLOADED_TAG = "recrl.export_uploaded"  # tag of the parent run: time of the exported state, in UTC
INTERVAL_SECONDS = 600.0  # least time between two uploads while the sweep runs
REST = 100.0  # multiple of the time of the last upload

now = time.monotonic
ExportWriter = Callable[[SweepStore, Path], object]


class ExportUpload:
    """Upload of the export file at the end of a sweep, and at intervals before."""

    def __init__(self, store: SweepStore, runs: SweepRuns, write: ExportWriter, folder: Path) -> None:
        """Prepare uploads; the first one of a running sweep is after one interval.

        Args:
            store: the sweep.
            runs: its runs.
            write: writes the export file of a sweep.
            folder: for the file until it is sent.
        """
        self._store = store
        self._runs = runs
        self._write = write
        self._path = folder / FILE_NAME
        self._due = now() + INTERVAL_SECONDS

    def bring_up_to_date(
        self, parent: Position, records: dict[str, TrialRecord], *, live: bool
    ) -> tuple[Position, str]:
        """Upload the file if the sweep changed and, while a launch runs, the interval is over.

        Args:
            parent: position of the parent run.
            records: of all trials, by folder name.
            live: whether a launch runs.

        Returns:
            The new position, and the reason why the file could not be uploaded, or empty.
        """
        mark = _mark(records)
        if not records or parent.shown.get("export") == mark or (live and now() < self._due):
            return parent, ""
        began = now()
        try:
            self._upload()
        except Exception as error:  # a server may accept small files only; the runs are shown nevertheless
            return parent, redacted(first_line(error) or type(error).__name__)
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
        self._runs.client.set_tag(self._runs.parent_id, UPLOADED_TAG, at, synchronous=True)


def write_in_own_process(store: SweepStore, path: Path) -> None:
    """Write a sweep's export file in a separate process, so that this one does not import pandas.

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
        lines: Sequence[str] = done.stderr.strip().splitlines() or ["it prints no reason"]
        raise TrackingError(f"recrl-sweep export failed: {lines[-1]}")


def _mark(records: dict[str, TrialRecord]) -> str:
    """Return the values that change whenever a trial begins, commits or ends."""
    known = [
        (name, str(record.status), record.attempt, sorted(record.committed.items()))
        for name, record in sorted(records.items())
    ]
    return hashlib.sha256(repr(known).encode()).hexdigest()
