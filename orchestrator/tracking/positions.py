"""How much of a sweep MLflow has been told, kept in files of the sweep's folder.

A position is written after MLflow's reply. A process that is killed between the two sends the same points
again, with the timestamps of their rows, and MLflow keeps one of each. If a position is lost or damaged,
everything is sent again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from recrl.orchestrator.files.locks import locked
from recrl.orchestrator.files.small_files import write_json
from recrl.orchestrator.files.sweep_store import SweepStore


@dataclass(frozen=True)
class Position:
    """How much of a trial, or of the sweep itself, has been sent.

    Attributes:
        run_id: the run that shows it.
        offset: the byte of ``updates.csv`` behind the last row sent.
        last_row: that row; if the file says otherwise, it was cut back and written anew.
        shown: what the run shows besides points: status, attempt, error and so on.
        artifacts: name, size and time of the files sent.
        summary: the means that a complete trial ended with.
    """

    run_id: str
    offset: int = 0
    last_row: str = ""
    shown: Mapping[str, Any] = field(default_factory=dict)
    artifacts: Sequence[str] = ()
    summary: Mapping[str, float] = field(default_factory=dict)

    def fits(self, data: bytes) -> bool:
        """Return whether the committed rows still are those that were sent."""
        return data[self.offset - len(self.last_row) : self.offset] == self.last_row.encode()

    def write(self, path: Path) -> None:
        """Write it as JSON; ``read_position`` is the inverse."""
        write_json(path, asdict(self))


def read_position(path: Path) -> Position | None:
    """Return the position in a file; None if there is none, or none that makes sense."""
    try:
        position = Position(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    kinds = (str, int, str, dict, list, dict)
    values = (getattr(position, name) for name in Position.__dataclass_fields__)
    return position if all(map(isinstance, values, kinds)) else None


def sync_folder(store: SweepStore, uri: str) -> Path:
    """Return the folder of the positions for one MLflow store; the address itself may hold a password."""
    return store.sync_folder / hashlib.sha256(uri.encode()).hexdigest()[:10]


@contextmanager
def exclusive(store: SweepStore, uri: str) -> Iterator[None]:
    """Wait until no other process sends this sweep to this store; two would make every run twice."""
    folder = sync_folder(store, uri)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / "lock"):
        yield


def file_mark(path: Path) -> str:
    """Return what tells a file from what it was before."""
    stat = path.stat()
    return f"{path.name} {stat.st_size} {stat.st_mtime_ns}"
