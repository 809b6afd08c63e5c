"""End the processes of hanging trials, so that Tune starts these trials again."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import ray

from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.process_scope import is_own_scope
from recrl.orchestrator.ray.tune_trial import spec_of
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace

HEARTBEAT_READ_SECONDS = 2.0  # smallest time between two reads of the heartbeats
STARTUP_GRACE_FACTOR = 5  # startup grace period, in multiples of ``silence_seconds``

logger = logging.getLogger("recrl.sweep")


class HangWatchdog:
    """Watchdog that ends the processes of hanging trials, so that Tune starts these trials again.

    Silence is measured by this process's clock since it last saw a heartbeat change, so the nodes' clocks
    need not agree. Before its first heartbeat a process may be silent ``STARTUP_GRACE_FACTOR`` times as long:
    on a busy machine importing torch takes long. Until then the files are those of an earlier attempt.
    """

    def __init__(self, place: SweepPlace, seconds: float) -> None:
        self._place = place
        self._store = place.store
        self._seconds = seconds
        self._last: dict[str, tuple[tuple[int, float], float]] = {}
        self._before: dict[str, tuple[int, float]] = {}
        self._checked_at = float("-inf")

    def begin(self, trial: Any) -> None:
        """Record that a process starts one of Tune's trials."""
        heartbeat = _heartbeat_of(self._store.trial(spec_of(trial)).record())
        self._before[trial.trial_id] = heartbeat
        self._last[trial.trial_id] = (heartbeat, time.monotonic())

    def end(self, trials: Sequence[Any]) -> None:
        """End the running trials without a heartbeat."""
        now = time.monotonic()
        if now < self._checked_at + look_seconds(self._seconds):
            return
        self._checked_at = now
        if self._place.is_out_of_touch(self._seconds):
            self._last.clear()  # this machine cannot read the heartbeats
            return
        for trial in trials:
            if trial.status != "RUNNING":
                self._last.pop(trial.trial_id, None)
                continue
            spec = spec_of(trial)
            record = self._store.trial(spec).record()
            heartbeat = _heartbeat_of(record)
            last, seen_at = self._last.get(trial.trial_id, (None, now))
            if heartbeat != last:
                self._last[trial.trial_id] = (heartbeat, now)
                continue
            has_beaten = heartbeat != self._before.get(trial.trial_id)
            patience = self._seconds * (1 if has_beaten else STARTUP_GRACE_FACTOR)
            if now - seen_at > patience and (record.status is TrialStatus.RUNNING or not has_beaten):
                self._last[trial.trial_id] = (heartbeat, float("inf"))  # once per silence
                logger.warning("%s: no sign of work for %.0f seconds", spec.title, patience)
                _end_process(record if has_beaten else None, trial.temporary_state.ray_actor)


def _heartbeat_of(record: TrialRecord) -> tuple[int, float]:
    """Return the values that change with every sign of life."""
    return record.attempt, record.heartbeat


def look_seconds(silence_seconds: float) -> float:
    """Return the time until the next read of the heartbeats: each read opens a file per running trial."""
    return min(max(HEARTBEAT_READ_SECONDS, silence_seconds / 30.0), silence_seconds / 4.0)


def _end_process(record: TrialRecord | None, actor: Any) -> None:
    """Kill a trial's process; directly if it is visible here, because a stopped process serves no request.

    Args:
        record: the process's own record, if any.
        actor: Ray's handle of it, if any.
    """
    if record is not None and is_own_scope(record.pid_scope) and _is_worker(record.pid):
        with suppress(ProcessLookupError):  # it has just ended
            os.kill(record.pid, signal.SIGKILL)
    elif actor is not None:
        ray.kill(actor)


def _is_worker(pid: int) -> bool:
    """Whether the process is one of Ray's: its id may have been reused."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::")
    except OSError:
        return False
