"""Progress of a sweep, from its files alone: from any terminal, also after the launch has died."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.process_scope import has_ended
from recrl.orchestrator.spec import TrialSpec, TrialStatus


class DisplayStatus(StrEnum):
    """Status of a trial for display: the recorded status, and whether its process is alive."""

    COMPLETE = "complete"
    RUNNING = "running"
    WAITING = "waiting"
    STOPPED = "stopped"
    INTERRUPTED = "interrupted"
    FAILED = "failed"
    DAMAGED = "damaged"


@dataclass(frozen=True)
class TrialProgress:
    """Progress of one trial.

    Attributes:
        spec: the trial.
        status: for display.
        record: from its files.
    """

    spec: TrialSpec
    status: DisplayStatus
    record: TrialRecord

    @property
    def fraction(self) -> float:
        """Fraction of its environment steps that is done, in [0, 1]; 0 for a damaged trial."""
        if self.status is DisplayStatus.COMPLETE:
            return 1.0
        if self.status is DisplayStatus.DAMAGED:
            return 0.0
        return min(1.0, self.record.env_steps / self.spec.total_steps)


@dataclass(frozen=True)
class SweepProgress:
    """Progress of a sweep.

    Attributes:
        trials: each trial, in the grid's order.
    """

    trials: tuple[TrialProgress, ...]

    @property
    def counts(self) -> Mapping[DisplayStatus, int]:
        """Number of trials by status."""
        found = Counter(trial.status for trial in self.trials)
        return {status: found[status] for status in DisplayStatus}

    @property
    def fraction(self) -> float:
        """Fraction of all environment steps that is done, in [0, 1]; 1 for no trials."""
        total = sum(trial.spec.total_steps for trial in self.trials)
        return sum(trial.fraction * trial.spec.total_steps for trial in self.trials) / total if total else 1.0

    @property
    def steps_left(self) -> float:
        """Remaining environment steps of all trials but the failed and those left as damaged."""
        return sum(
            (1.0 - trial.fraction) * trial.spec.total_steps
            for trial in self.trials
            if trial.status is not DisplayStatus.FAILED and not trial.record.is_left_alone
        )

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second of all running trials together."""
        return sum(trial.record.steps_per_second for trial in self.with_status(DisplayStatus.RUNNING))

    @property
    def seconds_left(self) -> float | None:
        """Remaining time at the present speed, or None while no trial runs."""
        return self.steps_left / self.steps_per_second if self.steps_per_second > 0.0 else None

    @property
    def is_complete(self) -> bool:
        """Whether every trial is complete."""
        return all(trial.status is DisplayStatus.COMPLETE for trial in self.trials)

    def with_status(self, *statuses: DisplayStatus) -> tuple[TrialProgress, ...]:
        """Return the trials with one of these statuses."""
        return tuple(trial for trial in self.trials if trial.status in statuses)


def progress(specs: Sequence[TrialSpec], store: SweepStore, *, now: float | None = None) -> SweepProgress:
    """Read the progress of trials; a trial that is to run again counts as not yet begun.

    Args:
        specs: the trials of the grid.
        store: the sweep's files.
        now: seconds since 1970; the present by default.
    """
    now = time.time() if now is None else now
    silence = store.silence_seconds
    trials = []
    for spec in specs:
        record = shown_record(store.trial(spec))
        trials.append(TrialProgress(spec, display_status(record, now=now, silence_seconds=silence), record))
    return SweepProgress(tuple(trials))


def shown_record(trial: TrialStore) -> TrialRecord:
    """Return a trial's record for display: blank if the trial is to run again from its beginning."""
    return TrialRecord() if trial.rerun_path.exists() else trial.record()


def display_status(record: TrialRecord, *, now: float, silence_seconds: float) -> DisplayStatus:
    """Return the status of a trial for display: the recorded one, unless its process has died.

    Args:
        record: of the trial.
        now: seconds since 1970.
        silence_seconds: after which a running trial counts as dead; see ``SweepStore.silence_seconds``.
    """
    match record.status:
        case TrialStatus.COMPLETE:
            return DisplayStatus.COMPLETE
        case TrialStatus.FAILED:
            return DisplayStatus.FAILED
        case TrialStatus.DAMAGED:
            return DisplayStatus.DAMAGED
        case TrialStatus.WAITING:
            return DisplayStatus.STOPPED if record.attempt else DisplayStatus.WAITING
        case TrialStatus.RUNNING:
            silent = abs(now - record.heartbeat) > silence_seconds  # also if another clock is ahead
            is_dead = silent or has_ended(record.pid, record.pid_scope)
            return DisplayStatus.INTERRUPTED if is_dead else DisplayStatus.RUNNING
