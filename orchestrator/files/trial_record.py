"""The record of a trial in its ``state.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.spec import TrialStatus

NOT_STORED = ("is_left_alone", "is_unreadable")


@dataclass(frozen=True)
class TrialRecord:
    """Content of ``state.json``.

    Attributes:
        status: the trial's state.
        attempt: number of starts; 0 if never started.
        token: the lease of the attempt that may write.
        update: policy updates done.
        env_steps: environment steps taken.
        total_steps: environment steps of the whole trial.
        started_at: when the first attempt began, seconds since 1970.
        heartbeat: time of the last sign of life of an attempt, seconds since 1970.
        cpu_seconds: CPU time of all attempts, as far as committed.
        steps_per_second: environment steps per wall second, over the last interval.
        host: the machine of the last attempt.
        pid: its process.
        pid_scope: where that id has a meaning, see ``process_scope``; empty if unknown.
        committed: lengths in bytes of the files, by their names, as of the last commit.
        digests: SHA-256 of the committed bytes of each.
        checkpoint: name of the checkpoint of the last commit, or empty.
        start_limits: the training limits d_t with which the curriculum started, measured or as given, [k],
            or None.
        error: one line with the reason of a failure or the damage, or empty.
        is_left_alone: whether a damaged trial runs again only on request; not stored.
        is_unreadable: whether its files cannot be read at present, which is no damage; not stored.
    """

    status: TrialStatus = TrialStatus.WAITING
    attempt: int = 0
    token: str = ""
    update: int = 0
    env_steps: int = 0
    total_steps: int = 0
    started_at: float = 0.0
    heartbeat: float = 0.0
    cpu_seconds: float = 0.0
    steps_per_second: float = 0.0
    host: str = ""
    pid: int = 0
    pid_scope: str = ""
    committed: dict[str, int] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    start_limits: list[float | str] | None = None
    error: str = ""
    is_left_alone: bool = False
    is_unreadable: bool = False

    @property
    def extents(self) -> dict[str, Extent]:
        """Committed extent of each file, by its name."""
        return {name: Extent(length, self.digests.get(name, "")) for name, length in self.committed.items()}

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values; ``from_json`` is its inverse."""
        return {name: value for name, value in asdict(self).items() if name not in NOT_STORED}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> TrialRecord:
        """Return the record of ``to_json``."""
        return cls(**{**value, "status": TrialStatus(value["status"])})


def as_fields(extents: Mapping[str, Extent]) -> dict[str, Any]:
    """Return the fields of a TrialRecord that describe committed files."""
    return {
        "committed": {name: extent.length for name, extent in extents.items()},
        "digests": {name: extent.sha256 for name, extent in extents.items()},
    }
