"""Ends the processes of trials that hang, so that Tune starts these trials again."""

from __future__ import annotations

import logging
import os
import signal
import socket
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ray

from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.places import SweepPlace
from recrl.orchestrator.ray.tune_trial import spec_of
from recrl.orchestrator.spec import TrialState

HEARTBEAT_SECONDS = 2.0  # between two looks at the heartbeats, at least
STARTUP_GRACE_FACTOR = 5  # startup grace period, in multiples of ``silence_seconds``

logger = logging.getLogger("recrl.sweep")


class HangWatchdog:
    """Ends the processes of trials that hang, so that Tune starts these trials again.

    Silence is measured on this process's clock, from when it last saw a heartbeat change: the clocks of the
    nodes need not agree. Before its first heartbeat a process may be silent ``STARTUP_GRACE_FACTOR`` times as
    long: on a busy machine it takes long to import torch. What is on disk until then is an earlier attempt's.
    """

    def __init__(self, place: SweepPlace, seconds: float) -> None:
        self._place = place
        self._store = place.store
        self._seconds = seconds
        self._heard: dict[str, tuple[tuple[int, float], float]] = {}
        self._before: dict[str, tuple[int, float]] = {}
        self._looked_at = float("-inf")

    def begin(self, trial: Any) -> None:
        """A process is given one of Tune's trials."""
        sign = _sign_of(self._store.trial(spec_of(trial)).record())
        self._before[trial.trial_id] = sign
        self._heard[trial.trial_id] = (sign, time.monotonic())

    def end(self, trials: Sequence[Any]) -> None:
        """End those of Tune's trials whose recrl trial runs without a heartbeat."""
        now = time.monotonic()
        if now < self._looked_at + look_seconds(self._seconds):
            return
        self._looked_at = now
        if self._place.is_out_of_touch(self._seconds):
            self._heard.clear()  # it is this machine that hears nothing
            return
        for trial in trials:
            if trial.status != "RUNNING":
                self._heard.pop(trial.trial_id, None)
                continue
            spec = spec_of(trial)
            record = self._store.trial(spec).record()
            sign = _sign_of(record)
            last, heard_at = self._heard.get(trial.trial_id, (None, now))
            if sign != last:
                self._heard[trial.trial_id] = (sign, now)
                continue
            has_spoken = sign != self._before.get(trial.trial_id)
            patience = self._seconds * (1 if has_spoken else STARTUP_GRACE_FACTOR)
            if now - heard_at > patience and (record.status is TrialState.RUNNING or not has_spoken):
                self._heard[trial.trial_id] = (sign, float("inf"))  # once for a silence
                logger.warning("%s: no sign of work for %.0f seconds", spec.title, patience)
                _end_process(record if has_spoken else None, trial.temporary_state.ray_actor)


def _sign_of(record: TrialRecord) -> tuple[int, float]:
    """What changes with every sign of life."""
    return record.attempt, record.heartbeat


def look_seconds(silence_seconds: float) -> float:
    """How long not to look at the heartbeats: each look opens a file for every running trial."""
    return min(max(HEARTBEAT_SECONDS, silence_seconds / 30.0), silence_seconds / 4.0)


def _end_process(record: TrialRecord | None, actor: Any) -> None:
    """Kill a trial's process: directly where it is here, because one that is stopped serves no request.

    Args:
        record: what the process wrote of itself, if it did.
        actor: Ray's handle of it, if there is one.
    """
    if record is not None and record.host == socket.gethostname() and _is_worker(record.pid):
        os.kill(record.pid, signal.SIGKILL)
    elif actor is not None:
        ray.kill(actor)


def _is_worker(pid: int) -> bool:
    """Whether the process is one of Ray's: a number may have been given to another one meanwhile."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::")
    except OSError:
        return False
