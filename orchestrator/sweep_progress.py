"""How far a sweep is, from its files alone: from any terminal, also when whoever ran it is dead."""

from __future__ import annotations

import os
import socket
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.spec import TrialSpec, TrialState

# A trial says after its updates that it lives, and an update of big networks takes a minute or two; one that
# has been silent for so long has died.
SILENCE_SECONDS = 300.0


class Standing(StrEnum):
    """Where a trial stands for a person: its status, and whether it is still alive."""

    COMPLETE = "complete"
    RUNNING = "running"
    WAITING = "waiting"
    STOPPED = "stopped"
    INTERRUPTED = "interrupted"
    FAILED = "failed"
    DAMAGED = "damaged"


@dataclass(frozen=True)
class TrialProgress:
    """How far one trial is.

    Attributes:
        spec: the trial.
        standing: where it stands.
        record: what its files say.
    """

    spec: TrialSpec
    standing: Standing
    record: TrialRecord

    @property
    def fraction(self) -> float:
        """The share of its environment steps that is done, in [0, 1]; 0 of a damaged one."""
        if self.standing is Standing.COMPLETE:
            return 1.0
        if self.standing is Standing.DAMAGED:
            return 0.0
        return min(1.0, self.record.env_steps / self.spec.total_steps)


@dataclass(frozen=True)
class SweepProgress:
    """How far a sweep is.

    Attributes:
        trials: each trial, in the grid's order.
    """

    trials: tuple[TrialProgress, ...]

    @property
    def counts(self) -> Mapping[Standing, int]:
        """How many trials stand where."""
        found = Counter(trial.standing for trial in self.trials)
        return {standing: found[standing] for standing in Standing}

    @property
    def fraction(self) -> float:
        """The share of all environment steps that is done, in [0, 1]; 1 for no trials."""
        total = sum(trial.spec.total_steps for trial in self.trials)
        return sum(trial.fraction * trial.spec.total_steps for trial in self.trials) / total if total else 1.0

    @property
    def steps_left(self) -> float:
        """Environment steps of all trials that are neither complete nor failed."""
        return sum(
            (1.0 - trial.fraction) * trial.spec.total_steps
            for trial in self.trials
            if trial.standing is not Standing.FAILED
        )

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second of all running trials together."""
        return sum(trial.record.steps_per_second for trial in self.standing(Standing.RUNNING))

    @property
    def seconds_left(self) -> float | None:
        """Time left at the present speed, or None while nothing runs."""
        return self.steps_left / self.steps_per_second if self.steps_per_second > 0.0 else None

    @property
    def is_complete(self) -> bool:
        """Whether every trial is complete."""
        return all(trial.standing is Standing.COMPLETE for trial in self.trials)

    def standing(self, *standings: Standing) -> tuple[TrialProgress, ...]:
        """The trials that stand there."""
        return tuple(trial for trial in self.trials if trial.standing in standings)


def progress(specs: Sequence[TrialSpec], store: SweepStore, *, now: float | None = None) -> SweepProgress:
    """How far the trials are.

    Args:
        specs: the trials of the grid.
        store: the sweep's files.
        now: seconds since 1970; the present by default.
    """
    now = time.time() if now is None else now
    trials = []
    for spec in specs:
        record = store.trial(spec).record()
        trials.append(TrialProgress(spec, standing_of(record, now=now), record))
    return SweepProgress(tuple(trials))


def standing_of(record: TrialRecord, *, now: float) -> Standing:
    """Where a trial stands at a time: its status, unless it died without a word."""
    match record.status:
        case TrialState.COMPLETE:
            return Standing.COMPLETE
        case TrialState.FAILED:
            return Standing.FAILED
        case TrialState.DAMAGED:
            return Standing.DAMAGED
        case TrialState.WAITING:
            return Standing.STOPPED if record.attempt else Standing.WAITING
        case TrialState.RUNNING:
            silent = now - record.heartbeat > SILENCE_SECONDS
            return Standing.INTERRUPTED if silent or _has_no_process(record) else Standing.RUNNING


def _has_no_process(record: TrialRecord) -> bool:
    """Whether the trial's process was on this machine and is gone."""
    if record.host != socket.gethostname():
        return False
    try:
        os.kill(record.pid, 0)  # signal 0 only asks
    except ProcessLookupError:
        return True
    except PermissionError:
        pass  # somebody else's process, so it is there
    return False
