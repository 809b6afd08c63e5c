"""The files of a sweep: the truth that everything else (status, MLflow, figures) is a view of.

    <root>/<sweep>/
        sweep.json              name, creation time, recrl's version
        grid.yaml               the grid file as given to the last launch
        trials.jsonl            the trials of that grid, a TrialSpec a line, in their order
        lock                    held by the one process that runs the sweep
        stop.request            there while somebody asks that process to stop
        storage.json            of a mirror: the address of the object store that the sweep is kept in
        figures/                what ``recrl-sweep figures`` drew
        mlflow.db, mlartifacts/ the default MLflow store
        mirror/                 how far MLflow has been told, for each store it was told to
        trials/<task>__<agent>__<method>__s<seed>__<id>/
            spec.json           the TrialSpec
            state.json          the TrialRecord: status, progress, lease, committed file lengths
            episodes.csv        a row an episode: EPISODE_COLUMNS and one cost_i, limit_i per cost
            updates.csv         a row a policy update: UPDATE_COLUMNS and the student's own metrics
            events.jsonl        a line an event: noise added, limits measured, phase changed
            evaluation.csv      a row an episode of the frozen-policy evaluations: EVALUATION_COLUMNS
            policy.csv          of finite tasks: the final policy, a row a state, action_j for each action
            evaluations/        what ``recrl-sweep evaluate`` measured afterwards; no part of the trial
            videos/             episodes filmed by ``recrl-sweep evaluate --video``; no part of the trial
            checkpoints/        the newest two checkpoints
            provenance.json     versions, commit, machine
            log.txt, error.txt  the trial's log; the traceback of a failed trial
            .reserve            room for a running trial's last words, should the disk be full

Rules. Small files are written beside and renamed. Rows are appended only by ``TrialWriter.commit``, then
synced, then a checkpoint that holds the files' lengths is written, then ``state.json``: whatever dies
between, a restart cuts the files back to the newest intact checkpoint and nothing is there twice. Readers
look only at committed bytes. A writer holds a lease (a token in ``state.json``): once another attempt has
taken the trial over, its every write is refused. Where the disk is full or gone, a writer's methods raise
StorageError, and the last commit stands.
"""

from __future__ import annotations

import fcntl
import io
import json
import operator
import os
import secrets
import socket
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import pandas as pd

from recrl.environments.cmdp import EpisodeStats
from recrl.orchestrator import checkpoint
from recrl.orchestrator.errors import CheckpointError, LostLeaseError, StorageError, SweepBusyError
from recrl.orchestrator.spec import TrialSpec, TrialState

EPISODE_COLUMNS = ("index", "phase", "end_step", "length", "episode_return", "noise")
UPDATE_COLUMNS = (
    "update",
    "phase",
    "end_step",
    "episodes",
    "episode_return",
    "noise",
    "time",
    "collect_seconds",
    "update_seconds",
)
EVALUATION_COLUMNS = ("policy", "index", "length", "episode_return")
_episode_values = operator.attrgetter(*EPISODE_COLUMNS)
KEPT_CHECKPOINTS = 2
LOOK_SECONDS = 10.0  # that others may take, all together, to look whether a sweep is locked
RESERVE_BYTES = 16 * 1024  # a record and a traceback


def write_atomically(path: Path, data: bytes) -> None:
    """Write a whole file so that a reader, or a crash, sees the old one or the new one, never a part."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write strict JSON atomically."""
    write_atomically(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file atomically: at least one row, all with the same keys."""
    lines = [_csv_line(rows[0]), *(_csv_line(row.values()) for row in rows)]
    write_atomically(path, "".join(lines).encode())


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
        committed: lengths in bytes of the row files, as of the last commit.
        start_limits: the training limits d_t the teacher measured, or None.
        error: one line saying why the trial failed, or empty.
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
    start_limits: list[float | str] | None = None
    error: str = ""

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> TrialRecord:
        """The record that was written as JSON."""
        return cls(**{**value, "status": TrialState(value["status"])})


class SweepStore:
    """The folder of one sweep; every path in it is a property here.

    Attributes:
        folder: ``<root>/<sweep>``.
    """

    def __init__(self, root: Path, name: str) -> None:
        self.folder = root.absolute() / name
        self.name = name

    @property
    def grid_path(self) -> Path:
        """The grid file as given to the last launch."""
        return self.folder / "grid.yaml"

    @property
    def specs_path(self) -> Path:
        """The trials of the last launch's grid, a TrialSpec a line."""
        return self.folder / "trials.jsonl"

    @property
    def info_path(self) -> Path:
        """Name, creation time and version."""
        return self.folder / "sweep.json"

    @property
    def trials_folder(self) -> Path:
        """One folder a trial."""
        return self.folder / "trials"

    @property
    def figures_folder(self) -> Path:
        """What ``recrl-sweep figures`` draws."""
        return self.folder / "figures"

    @property
    def mlflow_database(self) -> Path:
        """The default MLflow store (sqlite)."""
        return self.folder / "mlflow.db"

    @property
    def mlflow_artifacts(self) -> Path:
        """The default place of MLflow's artifacts."""
        return self.folder / "mlartifacts"

    @property
    def mirror_folder(self) -> Path:
        """How far MLflow has been told; may be deleted at any time."""
        return self.folder / "mirror"

    @property
    def stop_request_path(self) -> Path:
        """Whether the process that runs the sweep is asked to stop."""
        return self.folder / "stop.request"

    @property
    def storage_path(self) -> Path:
        """Where the sweep is kept, if this folder only mirrors it."""
        return self.folder / "storage.json"

    def trial(self, spec: TrialSpec) -> TrialStore:
        """The trial's folder; it need not exist yet."""
        return self.trial_named(spec.folder_name)

    def trial_named(self, folder_name: str) -> TrialStore:
        """The trial in a folder of this name; it need not exist yet."""
        return TrialStore(self.trials_folder / folder_name)

    def specs(self) -> list[TrialSpec]:
        """The trials of the last launch's grid, in their order; none if there was no launch."""
        if not self.specs_path.exists():
            return []
        return [TrialSpec.from_json(json.loads(line)) for line in self.specs_path.read_text().splitlines()]

    def trials(self) -> list[TrialStore]:
        """Every trial on disk, in the order of the folders' names."""
        if not self.trials_folder.is_dir():
            return []
        return [TrialStore(path.parent) for path in sorted(self.trials_folder.glob("*/spec.json"))]

    def find(self, text: str) -> list[TrialStore]:
        """The trials on disk that are called so, or else all whose name begins so.

        Args:
            text: a trial's id, title or folder, or its beginning.
        """
        trials = self.trials()
        names = [(trial.spec.trial_id, trial.spec.title, trial.folder.name) for trial in trials]
        called = [trial for trial, known in zip(trials, names, strict=True) if text in known]
        begins = (any(name.startswith(text) for name in known) for known in names)
        return called or [trial for trial, fits in zip(trials, begins, strict=True) if fits]

    def is_locked(self) -> bool:
        """Whether some process runs the sweep."""
        try:
            with (self.folder / "lock").open() as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except BlockingIOError:
            return True
        return False

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the sweep, so that no second process runs it.

        Raises:
            SweepBusyError: another process holds it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "lock").open("a+") as file:
            if not _is_taken(file):
                file.seek(0)
                holder = file.read().strip() or "another process"
                raise SweepBusyError(
                    f"{self.folder}: this sweep is already being run by {holder}; wait for it or stop it"
                )
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
            file.flush()
            yield


def _is_taken(file: IO[str]) -> bool:
    """Take the exclusive lock of a file, unless somebody else holds it.

    ``SweepStore.is_locked`` holds a shared one for a moment: who only looks must not keep anybody from it.
    """
    end = time.monotonic() + LOOK_SECONDS
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            fcntl.flock(file, fcntl.LOCK_UN)
            if time.monotonic() > end:
                return False
            time.sleep((1 + secrets.randbelow(10)) / 1000.0)  # two who wait must not keep step


class TrialStore:
    """The folder of one trial: its paths, and what readers may know of it.

    Attributes:
        folder: the trial's folder; its name is ``TrialSpec.folder_name``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def spec_path(self) -> Path:
        """The TrialSpec as JSON."""
        return self.folder / "spec.json"

    @property
    def state_path(self) -> Path:
        """The TrialRecord as JSON."""
        return self.folder / "state.json"

    @property
    def episodes_path(self) -> Path:
        """A row an episode."""
        return self.folder / "episodes.csv"

    @property
    def updates_path(self) -> Path:
        """A row a policy update."""
        return self.folder / "updates.csv"

    @property
    def events_path(self) -> Path:
        """A line an event."""
        return self.folder / "events.jsonl"

    @property
    def evaluation_path(self) -> Path:
        """A row an episode of the frozen-policy evaluations."""
        return self.folder / "evaluation.csv"

    @property
    def policy_path(self) -> Path:
        """The final policy's table, where the task is finite."""
        return self.folder / "policy.csv"

    @property
    def evaluations_folder(self) -> Path:
        """What ``recrl-sweep evaluate`` measured afterwards."""
        return self.folder / "evaluations"

    @property
    def videos_folder(self) -> Path:
        """Filmed episodes."""
        return self.folder / "videos"

    @property
    def checkpoints_folder(self) -> Path:
        """The newest checkpoints."""
        return self.folder / "checkpoints"

    @property
    def provenance_path(self) -> Path:
        """Versions, commit and machine."""
        return self.folder / "provenance.json"

    @property
    def log_path(self) -> Path:
        """The trial's log."""
        return self.folder / "log.txt"

    @property
    def error_path(self) -> Path:
        """The traceback of a failed trial."""
        return self.folder / "error.txt"

    @property
    def reserve_path(self) -> Path:
        """Room that is given up to say, on a full disk, how a trial ended."""
        return self.folder / ".reserve"

    @cached_property
    def spec(self) -> TrialSpec:
        """What the trial is; it must be on disk."""
        return TrialSpec.from_json(json.loads(self.spec_path.read_text()))

    def record(self) -> TrialRecord:
        """Where the trial stands now; a blank record if it was never started."""
        try:
            return TrialRecord.from_json(json.loads(self.state_path.read_text()))
        except FileNotFoundError:
            return TrialRecord()

    def episodes(self) -> pd.DataFrame:
        """The committed episodes: EPISODE_COLUMNS, then cost_i and limit_i for each cost."""
        return self._committed_csv(self.episodes_path)

    def updates(self) -> pd.DataFrame:
        """The committed policy updates: UPDATE_COLUMNS, cost_i, limit_i, then the student's metrics."""
        return self._committed_csv(self.updates_path)

    def events(self) -> list[dict[str, Any]]:
        """The committed events, in order; each has ``update``, ``end_step`` and ``event``."""
        return [json.loads(line) for line in self._committed(self.events_path).splitlines()]

    def evaluation(self) -> pd.DataFrame:
        """The frozen-policy evaluations: EVALUATION_COLUMNS, then cost_i; empty before the end."""
        if not self.evaluation_path.exists():
            return pd.DataFrame(columns=list(EVALUATION_COLUMNS))
        return pd.read_csv(self.evaluation_path)

    def policy(self) -> pd.DataFrame:
        """The final policy pi(a | s): a row a state, columns action_j; empty if there is no table."""
        return pd.read_csv(self.policy_path) if self.policy_path.exists() else pd.DataFrame()

    def checkpoints(self) -> list[Path]:
        """The checkpoints on disk, newest first."""
        return sorted(self.checkpoints_folder.glob("checkpoint-*.recrl"), reverse=True)

    def latest_checkpoint(self) -> dict[str, Any] | None:
        """The newest intact checkpoint, or None; damaged ones are passed over."""
        for path in self.checkpoints():
            try:
                return checkpoint.load(path)
            except CheckpointError:
                continue
        return None

    def begin(self, spec: TrialSpec) -> TrialWriter:
        """Take the trial over: from now on only the returned writer may write.

        Args:
            spec: the trial; must be what the folder already holds, if anything.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self.checkpoints_folder.mkdir(parents=True, exist_ok=True)
            return self._begin(spec)

    def _begin(self, spec: TrialSpec) -> TrialWriter:
        with self.locked():
            self.reserve_path.write_bytes(secrets.token_bytes(RESERVE_BYTES))
            if not self.spec_path.exists():
                write_json(self.spec_path, spec.to_json())
            old = self.record()
            record = replace(
                old,
                status=TrialState.RUNNING,
                attempt=old.attempt + 1,
                token=secrets.token_hex(8),
                total_steps=spec.total_steps,
                started_at=old.started_at or time.time(),
                heartbeat=time.time(),
                host=socket.gethostname(),
                pid=os.getpid(),
                error="",
            )
            write_json(self.state_path, asdict(record))
        return TrialWriter(self, record)

    def set_status(self, status: TrialState, *, error: str = "") -> None:
        """Say from outside where the trial stands, for a trial that can no longer say it itself.

        Revokes the lease of whoever still writes.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self.folder.mkdir(parents=True, exist_ok=True)
            self.reserve_path.unlink(missing_ok=True)
            self._set_status(status, error)

    def _set_status(self, status: TrialState, error: str) -> None:
        with self.locked():
            record = replace(self.record(), status=status, error=error, token="")
            write_json(self.state_path, asdict(record))

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Turn what a full or lost disk raises into a StorageError that says how to go on."""
        try:
            yield
        except OSError as error:
            update = self.saved_update
            saved = f"it goes on from update {update}" if update else "it starts anew"
            raise StorageError(
                f"{self.folder.name}: its files cannot be written ({error.strerror or error}); "
                f"{saved} when there is room and the sweep is launched again"
            ) from error

    @property
    def saved_update(self) -> int:
        """The update of the newest checkpoint, intact or not; 0 if there is none."""
        names = [path.stem.removeprefix("checkpoint-") for path in self.checkpoints()[:1]]
        return int(names[0]) if names and names[0].isdecimal() else 0

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Exclude other writers of this trial on the same file system, for a moment."""
        with (self.folder / ".lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _committed(self, path: Path) -> bytes:
        length = self.record().committed.get(path.name, 0)
        if length == 0:
            return b""
        with path.open("rb") as file:
            return file.read(length)

    def _committed_csv(self, path: Path) -> pd.DataFrame:
        data = self._committed(path)
        return pd.read_csv(io.BytesIO(data)) if data else pd.DataFrame()


class TrialWriter:
    """The lease on a trial: buffers its rows and commits them together with a checkpoint.

    Attributes:
        store: the trial's folder.
        record: the last record this writer wrote.
    """

    def __init__(self, store: TrialStore, record: TrialRecord) -> None:
        self.store = store
        self.record = record
        self._rows: dict[Path, list[str]] = {
            store.episodes_path: [],
            store.updates_path: [],
            store.events_path: [],
        }
        self._episode_rows = self._rows[store.episodes_path]
        self._lengths = {path.name: 0 for path in self._rows}
        self._cpu_origin = time.process_time()
        self._cpu_before = record.cpu_seconds

    @property
    def cpu_seconds(self) -> float:
        """CPU time of all attempts of this trial so far."""
        return self._cpu_before + time.process_time() - self._cpu_origin

    def restore(self) -> dict[str, Any] | None:
        """The newest intact checkpoint, with the row files cut back to it; None to start afresh.

        A damaged checkpoint is renamed ``*.damaged`` and the one before it is used.
        """
        tree: dict[str, Any] | None = None
        with self._lease():
            for path in self.store.checkpoints():
                try:
                    tree = checkpoint.load(path)
                    break
                except CheckpointError:
                    path.rename(path.with_suffix(".damaged"))
            lengths = tree["files"] if tree else {}
            for path in self._rows:
                self._lengths[path.name] = int(lengths.get(path.name, 0))
                if path.exists():
                    os.truncate(path, self._lengths[path.name])
            self._cpu_before = float(tree["cpu_seconds"]) if tree else 0.0
            self._cpu_origin = time.process_time()
            self._write_record(committed=dict(self._lengths))
        return tree["trial"] if tree else None

    def append_episode(self, episode: EpisodeStats) -> None:
        """Add an episode's row to the next commit."""
        rows = self._episode_rows
        if not rows and self._lengths[self.store.episodes_path.name] == 0:
            costs = (f"cost_{i}" for i in range(len(episode.costs)))
            limits = (f"limit_{i}" for i in range(len(episode.limits)))
            rows.append(_csv_line((*EPISODE_COLUMNS, *costs, *limits)))
        rows.append(_csv_line((*_episode_values(episode), *episode.costs, *episode.limits.values)))

    def append_update(self, row: Mapping[str, Any]) -> None:
        """Add an update's row to the next commit; every row of a trial has the same keys."""
        self._append_csv(self.store.updates_path, row)

    def append_event(self, event: Mapping[str, Any]) -> None:
        """Add an event's line to the next commit."""
        self._rows[self.store.events_path].append(json.dumps(event) + "\n")

    def write_evaluation(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the frozen-policy evaluations, whole; at least one row, all with the same keys."""
        self._write_csv(self.store.evaluation_path, rows)

    def write_policy(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the final policy's table, whole: a row a state, at least one, all with the same keys."""
        self._write_csv(self.store.policy_path, rows)

    def commit(self, tree: dict[str, Any], *, update: int, env_steps: int, **changes: Any) -> None:
        """Make everything appended so far, and the trial's state, safe.

        Args:
            tree: the trial's whole state after ``update``.
            update: policy updates done.
            env_steps: environment steps taken.
            changes: further fields of the TrialRecord to set.

        Raises:
            LostLeaseError: another attempt runs the trial now; nothing was written.
            StorageError: the disk is full or gone; the previous commit stands.
        """
        with self._lease():
            lengths = {
                path.name: _append_synced(path, "".join(rows), at=self._lengths[path.name])
                for path, rows in self._rows.items()
            }
            cpu_seconds = self.cpu_seconds
            data = checkpoint.encode({"trial": tree, "files": lengths, "cpu_seconds": cpu_seconds})
            write_atomically(self.store.checkpoints_folder / f"checkpoint-{update:08d}.recrl", data)
            self._write_record(
                committed=lengths, update=update, env_steps=env_steps, cpu_seconds=cpu_seconds, **changes
            )
            self._lengths = lengths
            for rows in self._rows.values():
                rows.clear()
            for old in self.store.checkpoints()[KEPT_CHECKPOINTS:]:
                old.unlink()

    def heartbeat(self, *, update: int, env_steps: int, steps_per_second: float) -> None:
        """Say that the trial lives and how far it is; commits nothing.

        Raises:
            LostLeaseError: another attempt runs the trial now.
        """
        with self._lease():
            self._write_record(update=update, env_steps=env_steps, steps_per_second=steps_per_second)

    def close(self, status: TrialState, *, error: str = "", traceback: str = "") -> None:
        """End this attempt: complete, failed with an error, or waiting to be resumed."""
        with self._lease():
            self.store.reserve_path.unlink(missing_ok=True)
            if traceback:
                write_atomically(self.store.error_path, traceback.encode())
            self._write_record(status=status, error=error, steps_per_second=0.0)

    @contextmanager
    def _lease(self) -> Iterator[None]:
        with self.store.writing(), self.store.locked():
            if self.store.record().token != self.record.token:
                raise LostLeaseError(f"{self.store.folder.name}: another attempt runs this trial now")
            yield

    def _write_record(self, **changes: Any) -> None:
        self.record = replace(self.record, heartbeat=time.time(), **changes)
        write_json(self.store.state_path, asdict(self.record))

    def _write_csv(self, path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
        with self._lease():
            write_rows(path, rows)

    def _append_csv(self, path: Path, row: Mapping[str, Any]) -> None:
        if self._lengths[path.name] == 0 and not self._rows[path]:
            self._rows[path].append(_csv_line(row))
        self._rows[path].append(_csv_line(row.values()))


def _csv_line(values: Iterable[Any]) -> str:
    """A CSV line of numbers and plain words; floats as the shortest text that reads back equal."""
    return ",".join(map(str, values)) + "\n"


def _append_synced(path: Path, text: str, *, at: int) -> int:
    """Write ``text`` at byte ``at`` of a file, cutting off what was behind; returns the new length."""
    with path.open("r+b" if path.exists() else "w+b") as file:
        file.truncate(at)
        file.seek(at)
        file.write(text.encode())
        file.flush()
        os.fsync(file.fileno())
        return file.tell()
