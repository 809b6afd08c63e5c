"""How far a sweep has been sent to MLflow, recorded in files of the sweep's folder.

A position is written after MLflow's reply. After a kill between the two, the same points are sent again with
the timestamps of their rows, and MLflow keeps one of each. If a position is lost or damaged, everything is
sent again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from recrl.orchestrator.files.atomic_files import write_json
from recrl.orchestrator.files.locks import locked
from recrl.orchestrator.files.sweep_store import SweepStore


@dataclass(frozen=True)
class Position:
    """How far a trial, or the sweep itself, has been sent.

    Attributes:
        run_id: its run.
        offset: in ``updates.csv``, after the last row sent.
        last_row: that row; if the file differs, it was truncated and written again.
        shown: content of the run besides points: status, attempt, error and so on.
        artifacts: ``file_mark`` of each file sent, by its place among the run's artifacts.
    """

    run_id: str
    offset: int = 0
    last_row: str = ""
    shown: Mapping[str, Any] = field(default_factory=dict)
    artifacts: Mapping[str, str] = field(default_factory=dict)

    def fits(self, data: bytes) -> bool:
        """Return whether the committed rows are still the sent ones."""
        return data[self.offset - len(self.last_row) : self.offset] == self.last_row.encode()

    def write(self, path: Path) -> None:
        """Write the position as JSON; ``read_position`` is the inverse."""
        write_json(path, asdict(self))


def read_position(path: Path) -> Position | None:
    """Return the position in a file; None if it is missing or invalid."""
    try:
        saved = json.loads(path.read_text())
        position = Position(**{name: saved[name] for name in Position.__dataclass_fields__ if name in saved})
    except (OSError, ValueError, TypeError):
        return None
    kinds = (str, int, str, dict, dict)
    values = (getattr(position, name) for name in Position.__dataclass_fields__)
    return position if all(map(isinstance, values, kinds)) else None


def sync_folder(store: SweepStore, uri: str) -> Path:
    """Return the folder of the positions for one MLflow store; its name does not contain the address."""
    return store.sync_folder / hashlib.sha256(uri.encode()).hexdigest()[:10]


@contextmanager
def exclusive(store: SweepStore, uri: str) -> Iterator[None]:
    """Hold the lock for sending this sweep to this store; two processes would make every run twice."""
    folder = sync_folder(store, uri)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / "lock"):
        yield


def file_mark(path: Path) -> str:
    """Return a value that changes when the file does."""
    stat = path.stat()
    return f"{path.name} {stat.st_size} {stat.st_mtime_ns}"
