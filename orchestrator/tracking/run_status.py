"""The states that MLflow shows: RUNNING, FINISHED, FAILED, KILLED, SCHEDULED, of trials and of a sweep."""

from __future__ import annotations

import time
from collections.abc import Mapping

from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.sweep_progress import DisplayStatus, display_status

MAX_ERROR = 5_000  # characters of a failed trial's error


def trial_run_status(record: TrialRecord, *, live: bool, silence_seconds: float) -> str:
    """Return MLflow's state of a trial that has begun.

    Args:
        record: of the trial; ``attempt`` is at least 1.
        live: whether a launch runs that will resume waiting trials.
        silence_seconds: of ``SweepStore.silence_seconds``.
    """
    match display_status(record, now=time.time(), silence_seconds=silence_seconds):
        case DisplayStatus.COMPLETE:
            return "FINISHED"
        case DisplayStatus.FAILED | DisplayStatus.DAMAGED:
            return "FAILED"
        case DisplayStatus.RUNNING:
            return "RUNNING"
        case DisplayStatus.INTERRUPTED:
            return "KILLED"
        case DisplayStatus.STOPPED | DisplayStatus.WAITING:
            return "SCHEDULED" if live else "KILLED"


def state_tags(record: TrialRecord) -> dict[str, str]:
    """Return the changing tags of a trial's run; empty ones are left out."""
    tags = {
        "recrl.status": str(record.status),
        "recrl.attempt": str(record.attempt),
        "recrl.host": record.host,
        "recrl.error": record.error[:MAX_ERROR],
    }
    return {name: value for name, value in tags.items() if value}


def sweep_run_status(counts: Mapping[DisplayStatus, int], *, live: bool) -> str:
    """Return MLflow's state of a sweep with these numbers of trials by status."""
    if live or counts[DisplayStatus.RUNNING]:
        return "RUNNING"
    if counts[DisplayStatus.FAILED]:
        return "FAILED"
    complete = counts[DisplayStatus.COMPLETE] == sum(counts.values())
    return "FINISHED" if complete else "KILLED"
