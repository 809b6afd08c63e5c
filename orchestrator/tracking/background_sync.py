"""The process that keeps MLflow up to date while a sweep runs, so that training never waits for MLflow.

It reads only the sweep's files. It ends when its standard input closes: after a stop request, or because its
parent died. In both cases it makes a last pass, so that MLflow is correct also after a killed launch.
"""

from __future__ import annotations

import argparse
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.redaction import RedactedStream
from recrl.orchestrator.sweep_progress import DisplayStatus, display_status
from recrl.orchestrator.tracking.client import MLFLOW_SETTINGS, one_line
from recrl.orchestrator.tracking.export_file import write_in_own_process
from recrl.orchestrator.tracking.mlflow_sync import SyncReport, Tracker, without_export
from recrl.orchestrator.tracking.positions import sync_folder

POLITENESS = 10  # added to the process's nice value: about a tenth of a core next to a trial
LONGEST_WAIT_SECONDS = 60.0  # between two passes while MLflow is unreachable
ORPHAN_SECONDS = 15.0  # trials outlive a killed launch by some seconds; the last pass waits for them


@dataclass
class BackgroundSync:
    """The process that keeps MLflow up to date during a launch; it ends when its parent does.

    Attributes:
        process: the leader of its own process group.
    """

    process: subprocess.Popen[bytes]

    def stop(self, timeout: float) -> bool:
        """Request a last pass and wait for it; the next ``sync`` copies the rest.

        Args:
            timeout: seconds, at least 0; then the process is killed.

        Returns:
            Whether MLflow is up to date.
        """
        if self.process.stdin:
            self.process.stdin.close()
        try:
            return self.process.wait(timeout) == 0
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError, PermissionError):  # it has just ended
                os.killpg(self.process.pid, signal.SIGKILL)  # with the process that writes the export file
            self.process.wait()
            return False


def start_sync(store: SweepStore, uri: str, *, interval_seconds: float) -> BackgroundSync:
    """Keep MLflow up to date from a separate process, until ``stop`` is called or this process dies.

    Args:
        store: the sweep.
        uri: of ``tracking_uri``.
        interval_seconds: between two passes, above 0; longer while MLflow is unreachable.
    """
    folder = sync_folder(store, uri)
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "recrl.orchestrator.tracking.background_sync", str(store.folder)]
    flags = os.O_CREAT | os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW
    with open(os.open(folder / "log.txt", flags, 0o600), "ab") as log:
        process = subprocess.Popen(
            [*command, "--interval", str(interval_seconds), "--parent", str(os.getpid())],
            # In the environment and not among the arguments, which other users can see.
            env={**MLFLOW_SETTINGS, **os.environ, "MLFLOW_TRACKING_URI": uri, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C is for the launch, which then stops this process
        )
    return BackgroundSync(process)


def main(argv: Sequence[str] | None = None) -> int:
    """Copy a sweep to MLflow until standard input closes; the process of ``start_sync``."""
    parser = argparse.ArgumentParser(
        prog="python -m recrl.orchestrator.tracking.background_sync", description=main.__doc__
    )
    parser.add_argument("folder", type=Path, help="the sweep's folder")
    parser.add_argument("--interval", type=float, required=True, help="seconds between two passes")
    parser.add_argument("--parent", type=int, required=True, help="the process to end with")
    arguments = parser.parse_args(argv)
    sys.stdout, sys.stderr = RedactedStream(sys.stdout), RedactedStream(sys.stderr)
    os.nice(POLITENESS)
    store = SweepStore(arguments.folder.parent, arguments.folder.name)
    tracker = Tracker(store, os.environ["MLFLOW_TRACKING_URI"], write_in_own_process)
    wait = 0.0  # a launch with nothing to do is already over: one pass is enough
    before = SyncReport()
    while not _is_over(arguments.parent, wait):
        report = _pass(tracker, before, live=True)
        longer = min(2 * max(wait, arguments.interval), LONGEST_WAIT_SECONDS)
        wait, before = longer if report.is_broken_off else arguments.interval, report
    end = time.monotonic() + ORPHAN_SECONDS
    while _any_runs(store) and time.monotonic() < end:
        time.sleep(0.5)
    return 0 if _pass(tracker, before, live=False).is_up_to_date else 1


def _pass(tracker: Tracker, before: SyncReport, *, live: bool) -> SyncReport:
    """Make a pass, and log what is new since the one before."""
    try:
        report = tracker.bring_up_to_date(live=live)
    except OSError as error:  # a full disk, for example: the next pass may succeed
        report = SyncReport(problem=one_line(error), is_broken_off=True)
    if report.problem and (report.is_broken_off or report.problem != before.problem):
        print(f"{time.strftime('%F %T')} {report.problem}", flush=True)
    if report.remark and report.remark != before.remark:
        print(f"{time.strftime('%F %T')} {without_export(report.remark)}", flush=True)
    return report


def _any_runs(store: SweepStore) -> bool:
    silence = store.silence_seconds
    return any(
        display_status(trial.record(), now=time.time(), silence_seconds=silence) is DisplayStatus.RUNNING
        for trial in store.trials()
    )


def _is_over(parent: int, seconds: float) -> bool:
    """Wait; return whether standard input was closed or the parent died meanwhile."""
    readable, _, _ = select.select([sys.stdin], [], [], seconds)
    return bool(readable) or os.getppid() != parent


if __name__ == "__main__":
    sys.exit(main())
