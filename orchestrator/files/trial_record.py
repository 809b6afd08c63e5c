"""What is known of a trial from its ``state.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.spec import TrialState


@dataclass(frozen=True)
class TrialRecord:
    """What ``state.json`` says of a trial.

    Attributes:
        status: where it stands.
        attempt: how often it was started, from 1; 0 if never.
        token: the lease of the attempt that may write.
        update: policy updates done.
        env_steps: environment steps taken.
        total_steps: environment steps of the whole trial.
        started_at: when the first attempt began, seconds since 1970.
        heartbeat: when an attempt last said that it lives, seconds since 1970.
        cpu_seconds: CPU time of all attempts, as far as committed.
        steps_per_second: environment steps per wall second, over the last interval.
        host: the machine of the last attempt.
        pid: its process.
        committed: lengths in bytes of the files, by their names, as of the last commit.
        digests: SHA-256 of so many bytes of each.
        checkpoint: name of the checkpoint of the last commit, or empty.
        start_limits: the training limits d_t the teacher measured, or None.
        error: one line saying why the trial failed or what of it is damaged, or empty.
        claims: of a damaged trial the status that its files claim, None if they do not; not in the file.
    """

    status: TrialState = TrialState.WAITING
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
    committed: dict[str, int] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    start_limits: list[float | str] | None = None
    error: str = ""
    claims: TrialState | None = None

    @property
    def extents(self) -> dict[str, Extent]:
        """What is committed of each file, by its name."""
        return {name: Extent(length, self.digests.get(name, "")) for name, length in self.committed.items()}

    def to_json(self) -> dict[str, Any]:
        """The record as JSON values; ``from_json`` is its inverse."""
        return {name: value for name, value in asdict(self).items() if name != "claims"}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> TrialRecord:
        """The record that was written as JSON."""
        return cls(**{**value, "status": TrialState(value["status"])})


def as_fields(extents: Mapping[str, Extent]) -> dict[str, Any]:
    """The fields of a TrialRecord that say what is committed."""
    return {
        "committed": {name: extent.length for name, extent in extents.items()},
        "digests": {name: extent.sha256 for name, extent in extents.items()},
    }
