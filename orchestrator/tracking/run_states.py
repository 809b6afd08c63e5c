"""What MLflow calls the state of a trial and of a sweep, and the tags that say more."""

from __future__ import annotations

import time
from collections.abc import Mapping

from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.sweep_progress import Standing, standing_of

MAX_ERROR = 5_000  # characters of a failed trial's error


def mlflow_status(record: TrialRecord, *, live: bool) -> str:
    """Return what MLflow calls the state of a trial that has begun.

    Args:
        record: of the trial; ``attempt`` is at least 1.
        live: whether a launch runs that will resume what waits.
    """
    match standing_of(record, now=time.time()):
        case Standing.COMPLETE:
            return "FINISHED"
        case Standing.FAILED | Standing.DAMAGED:
            return "FAILED"
        case Standing.RUNNING:
            return "RUNNING"
        case Standing.INTERRUPTED:
            return "KILLED"
        case Standing.STOPPED | Standing.WAITING:
            return "SCHEDULED" if live else "KILLED"


def sweep_status(counts: Mapping[Standing, int], *, live: bool) -> str:
    """Return what MLflow calls the state of a sweep with so many trials of each standing."""
    if live or counts[Standing.RUNNING]:
        return "RUNNING"
    if counts[Standing.FAILED]:
        return "FAILED"
    complete = counts[Standing.COMPLETE] == sum(counts.values())
    return "FINISHED" if complete else "KILLED"


def state_tags(record: TrialRecord) -> dict[str, str]:
    """Return the tags of a trial's run that change while it works; empty ones are left out."""
    tags = {
        "recrl.status": str(record.status),
        "recrl.attempt": str(record.attempt),
        "recrl.host": record.host,
        "recrl.error": record.error[:MAX_ERROR],
    }
    return {name: value for name, value in tags.items() if value}
