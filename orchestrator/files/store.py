"""The files of a sweep: the truth that everything else (status, MLflow, figures) is a view of.

    <root>/<sweep>/
        sweep.json              name, creation time, recrl's version
        grid.yaml               the grid file as given to the last launch
        trials.jsonl            how many trials that grid has, then a TrialSpec a line, in their order
        lock                    held by the one process that runs the sweep
        stop.request            there while somebody asks that process to stop
        storage.json            of a mirror: the address of the object store that the sweep is kept in
        figures/                what ``recrl-sweep figures`` drew
        mlflow.db, mlartifacts/ the default MLflow store
        mirror/                 how far MLflow has been told, for each store it was told to
        trials/<task>__<agent>__<method>__s<seed>__<id>/
            spec.json           the TrialSpec
            state.json          the TrialRecord: status, progress, lease, committed lengths and digests
            episodes.csv        a row an episode: EPISODE_COLUMNS and one cost_i, limit_i per cost
            updates.csv         a row a policy update: UPDATE_COLUMNS and the student's own metrics
            events.jsonl        a line an event: noise added, limits measured, phase changed
            evaluation.csv      a row an episode of the frozen-policy evaluations: EVALUATION_COLUMNS
            policy.csv          of finite tasks: the final policy, a row a state, action_j for each action
            evaluations/        what ``recrl-sweep evaluate`` measured afterwards; no part of the trial
            videos/             episodes filmed by ``recrl-sweep evaluate --video``; no part of the trial
            checkpoints/        the newest two checkpoints
            provenance.json     of each attempt: versions, commit, machine, digests of the code
            log.txt, error.txt  the trial's log; the traceback of a failed trial
            aside/              what was damaged or replaced, as it was when an attempt began
            .reserve            room for a running trial's last words, should the disk be full

Rules. Small files are written beside and renamed. Rows are appended only by ``TrialWriter.commit``, then
synced, then a checkpoint that holds the files' lengths and digests is written, then ``state.json``: whatever
dies between, a restart cuts the files back to the newest intact checkpoint and nothing is there twice.
Readers look only at committed bytes, and hold them against the record's digests. A file that is shorter than
its committed length, or whose committed bytes have changed, is damage: the trial's status is then DAMAGED,
and nothing is made of it. What an attempt cannot use, or replaces, it moves to ``aside/``. A writer holds a
lease (a token in ``state.json``): once another attempt has taken the trial over, its every write is refused.
Where the disk is full or gone, a writer's methods raise StorageError, and the last commit stands.
"""

from __future__ import annotations

import fcntl
import io
import json
import logging
import operator
import os
import re
import secrets
import shutil
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import pandas as pd

from recrl.environments.cmdp import EpisodeStats
from recrl.orchestrator.errors import (
    CheckpointError,
    DamagedError,
    LostLeaseError,
    OtherFormatError,
    RowError,
    StorageError,
    SweepBusyError,
)
from recrl.orchestrator.files import checkpoint
from recrl.orchestrator.files.locks import look_at_lock, open_lock
from recrl.orchestrator.files.row_files import Extent, RowFile, digest_of, rows_text, shortage
from recrl.orchestrator.files.small_files import (
    parsed_object,
    read_sealed,
    read_whole,
    sealed,
    write_atomically,
    write_sealed,
)
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
RECORD_FORMAT = 2
SPEC_FORMAT = 2
SPECS_FORMAT = 2
INFO_FORMAT = 2
PROVENANCE_FORMAT = 2
PROVENANCE = "provenance.json"
LOOKS = 3  # at files that an attempt may be changing, before they are called damaged
LOOK_SECONDS = 10.0  # that others may take, all together, to look whether a sweep is locked
RESERVE_BYTES = 16 * 1024  # a record and a traceback


_TRIAL = re.compile(r"__[0-9a-f]{10}$")

logger = logging.getLogger("recrl.trial")


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

    def info(self) -> dict[str, Any]:
        """What ``sweep.json`` says; nothing if there was no launch.

        Raises:
            DamagedError: it is not what was written.
        """
        try:
            info = read_sealed(self.info_path, version=INFO_FORMAT)
            if info.get("name") != self.name:
                raise DamagedError(f"{self.info_path.name} is that of another sweep, {info.get('name')}")
            return info
        except FileNotFoundError:
            return {}
        except DamagedError as error:
            raise type(error)(f"{self.name}: {error}; launching its grid again writes it anew") from error

    def write_info(self, info: Mapping[str, Any]) -> None:
        """Say in ``sweep.json`` what the sweep is."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_sealed(self.info_path, info, version=INFO_FORMAT)

    def specs(self) -> list[TrialSpec]:
        """The trials of the last launch's grid, in their order; none if there was no launch.

        Raises:
            DamagedError: the file that lists them is not what was written.
        """
        try:
            return self._listed()[1]
        except FileNotFoundError:
            if not self._was_launched():
                return []
            problem = DamagedError(f"{self.specs_path.name} is missing")
        except DamagedError as error:
            problem = error
        raise type(problem)(f"{self.name}: {problem}; launching its grid again writes it anew") from problem

    def write_specs(self, specs: Sequence[TrialSpec], grid_text: bytes = b"") -> None:
        """Write the trials of a grid, and that grid's text.

        Args:
            specs: the trials, in their order.
            grid_text: the grid file; empty if there is none.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        lines = "".join(json.dumps(spec.to_json(), allow_nan=False) + "\n" for spec in specs).encode()
        of_lines, of_grid = Extent.of(lines).sha256, Extent.of(grid_text).sha256
        told = {
            "name": self.name,
            "created": self._created(),
            "trials": len(specs),
            "lines": of_lines,
            "grid": of_grid,
        }
        header = sealed(told, version=SPECS_FORMAT)
        if grid_text:
            write_atomically(self.grid_path, grid_text)
        write_atomically(self.specs_path, (json.dumps(header) + "\n").encode() + lines)

    def grid_text(self) -> tuple[str, str]:
        """The grid file of the last launch, and a sentence on what is wrong with it; either may be empty."""
        try:
            data = read_whole(self.grid_path)
        except FileNotFoundError:
            data = b""
        except StorageError as error:
            return "", f"{error}; launching the grid again writes it anew"
        try:
            expected = self._listed()[0]
        except (FileNotFoundError, StorageError):
            expected = Extent.of(data).sha256  # nobody knows better
        if Extent.of(data).sha256 != expected:
            what = "is not what was written" if data else "is missing"
            return "", f"{self.grid_path.name} {what}; launching the grid again writes it anew"
        return data.decode(errors="replace"), ""

    def _listed(self) -> tuple[str, list[TrialSpec]]:
        """The digest of the grid file, and the trials, that ``trials.jsonl`` holds.

        Raises:
            FileNotFoundError: it is not there.
            DamagedError: it is not what was written.
        """
        name = self.specs_path.name
        first, _, lines = read_whole(self.specs_path).partition(b"\n")
        header = parsed_object(first, name)
        found = header.get("format")
        if found != SPECS_FORMAT:
            raise OtherFormatError(
                f"{name} has format {found!r}, of another version of recrl, and this one reads format "
                f"{SPECS_FORMAT}"
            )
        told = {key: value for key, value in header.items() if key not in ("format", "sha256")}
        if header != sealed(told, version=SPECS_FORMAT) or Extent.of(lines).sha256 != told["lines"]:
            raise DamagedError(f"{name} is not what was written: its checksum differs")
        created = self._created()
        if told["name"] != self.name or (created and told["created"] not in (None, created)):
            raise DamagedError(f"{name} is not of this sweep, or {self.info_path.name} is not")
        return told["grid"], [TrialSpec.from_json(json.loads(line)) for line in lines.splitlines()]

    def _created(self) -> float | None:
        """When the sweep was first launched, seconds since 1970; None if nobody knows."""
        try:
            return self.info().get("created")
        except StorageError:
            return None

    def _was_launched(self) -> bool:
        try:
            return "launched" in self.info()
        except StorageError:
            return True

    def damages(self) -> list[str]:
        """A sentence for each file of the sweep itself, not of its trials, that is not what was written."""
        found = []
        for look in (self.info, self.specs):
            try:
                look()
            except StorageError as error:
                found.append(str(error).removeprefix(f"{self.name}: "))
        if not self.info_path.exists() and self.specs_path.exists():
            found.append(f"{self.info_path.name} is missing; launching the grid again writes it anew")
        if wrong_grid := self.grid_text()[1]:
            found.append(wrong_grid)
        if self.trials_folder.exists() and not self.trials_folder.is_dir():
            found.append(f"{self.trials_folder.name} is a file, it must be a folder; move it away")
        return found

    def trials(self) -> list[TrialStore]:
        """Every trial on disk, in the order of the folders' names."""
        if not self.trials_folder.is_dir():
            return []
        trials = [TrialStore(path) for path in sorted(self.trials_folder.iterdir())]
        return [
            trial
            for trial in trials
            if trial.spec_path.exists()
            or trial.state_path.exists()
            or (_TRIAL.search(trial.folder.name) and not trial.folder.is_dir())  # a file in its place
        ]

    def find(self, text: str) -> list[TrialStore]:
        """The trials on disk that are called so, or else all whose name begins so.

        Args:
            text: a trial's id, title or folder, or its beginning.
        """
        trials = self.trials()
        names = [(trial.trial_id, trial.title, trial.folder.name) for trial in trials]
        called = [trial for trial, known in zip(trials, names, strict=True) if text in known]
        begins = (any(name.startswith(text) for name in known) for known in names)
        return called or [trial for trial, fits in zip(trials, begins, strict=True) if fits]

    def is_locked(self) -> bool:
        """Whether some process runs the sweep."""
        try:
            with look_at_lock(self.folder / "lock") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return False
        return False

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the sweep, so that no second process runs it.

        Raises:
            SweepBusyError: another process holds it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for path in (self.folder / "lock", self.info_path, self.specs_path, self.grid_path):
            if path.is_dir():
                _move_aside(path, self.folder / "aside")
        if self.trials_folder.exists() and not self.trials_folder.is_dir():
            _move_aside(self.trials_folder, self.folder / "aside")
        with open_lock(self.folder / "lock") as file:
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
        return self.folder / PROVENANCE

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

    @property
    def aside_folder(self) -> Path:
        """What was damaged or replaced, as it was when an attempt began."""
        return self.folder / "aside"

    @property
    def trial_id(self) -> str:
        """The trial's id, from the folder's name."""
        return self.folder.name.rpartition("__")[2]

    @property
    def title(self) -> str:
        """What people call the trial: the spec's title, or the folder's name where that is damaged."""
        try:
            return self.spec.title
        except StorageError:
            return self.folder.name

    @property
    def is_mirror(self) -> bool:
        """Whether the folder only mirrors a trial that is kept in an object store."""
        return (self.folder / ".pulled.json").exists()

    @cached_property
    def spec(self) -> TrialSpec:
        """What the trial is; it must be on disk.

        Raises:
            DamagedError: the file that says it is missing, damaged or another trial's.
        """
        try:
            return self._read_spec()
        except DamagedError as error:
            raise type(error)(f"{self.folder.name}: {error}") from error

    def _read_spec(self) -> TrialSpec:
        name = self.spec_path.name
        try:
            value = read_sealed(self.spec_path, version=SPEC_FORMAT)
            spec = TrialSpec.from_json(value)
        except FileNotFoundError as error:
            raise DamagedError(f"{name} is missing") from error
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedError(f"{name} describes no trial ({error})") from error
        if spec.trial_id != self.trial_id:
            raise DamagedError(f"{name} is that of another trial, {spec.trial_id}")
        return spec

    def record(self) -> TrialRecord:
        """Where the trial stands now; a blank record if it was never started.

        The status is DAMAGED, and ``error`` says what is wrong and what to do, where the file that says it is
        damaged, or a committed file is shorter than it was. Digests are compared where rows are read, and by
        ``damages``.
        """
        stated = TrialRecord()
        for _ in range(LOOKS):
            try:
                stated, before = self._stated(), stated
            except StorageError as error:
                return self._damaged(TrialRecord(), error)
            wrong = self._short(stated)
            if wrong is None or stated == before:
                break
        return self._damaged(stated, wrong) if wrong else stated

    def stated(self) -> TrialRecord:
        """What ``state.json`` says, whatever the other files are; a blank record if there is none.

        Raises:
            DamagedError: it is not what was written.
        """
        try:
            return self._stated()
        except StorageError as error:
            raise type(error)(f"{self.folder.name}: {error}") from error

    def _stated(self) -> TrialRecord:
        try:
            value = read_sealed(self.state_path, version=RECORD_FORMAT)
            owner = value.pop("trial_id")
            if owner != self.trial_id:
                raise DamagedError(f"{self.state_path.name} is that of another trial, {owner}")
            return TrialRecord.from_json(value)
        except FileNotFoundError as error:
            if self.updates_path.exists() or self.episodes_path.exists() or self.checkpoints():
                raise DamagedError(f"{self.state_path.name} is missing") from error
            return TrialRecord()
        except (TypeError, ValueError, KeyError) as error:
            raise DamagedError(f"{self.state_path.name} is no record of a trial ({error})") from error

    def write_record(self, record: TrialRecord) -> None:
        """Write ``state.json``; whoever does it holds ``locked``."""
        value = {"trial_id": self.trial_id, **record.to_json()}
        write_sealed(self.state_path, value, version=RECORD_FORMAT)

    def _short(self, record: TrialRecord) -> StorageError | None:
        """What is wrong with the lengths of the committed files, if anything is."""
        for name, length in record.committed.items():
            path = self.folder / name
            if length == 0 and not path.is_dir():
                continue
            try:
                found = path.stat().st_size
            except FileNotFoundError:
                return DamagedError(f"{name} is missing, {length:,} bytes of it are committed")
            except OSError as error:
                return StorageError(f"{name} cannot be read ({error.strerror})")
            if path.is_dir():
                return DamagedError(f"{name} is a folder, it must be a file")
            if found < length:
                return DamagedError(f"{name} {shortage(found, length)}")
        return None

    def _damaged(self, stated: TrialRecord, error: StorageError) -> TrialRecord:
        """The record of a damaged trial, with a sentence that says what is wrong and what to do."""
        claims = stated.status if stated.attempt else None
        if isinstance(error, OtherFormatError):
            claims = TrialState.COMPLETE  # perhaps: nobody is to run it again unasked
        if self.is_mirror:
            remedy = "the sweep's folder is a mirror here: delete it, and it is fetched again"
        elif claims in (TrialState.COMPLETE, TrialState.FAILED):
            remedy = "launch --rerun-damaged runs the trial again and moves what is damaged aside"
        else:
            remedy = "the next launch goes on from what is whole and moves what is damaged aside"
        return replace(stated, status=TrialState.DAMAGED, claims=claims, error=f"{error}; {remedy}")

    def damages(self) -> list[str]:
        """A sentence for each file that is not what was committed, by lengths and digests.

        Empty for a whole trial, and for one that was never started.
        """
        found: list[str] = []
        stated = TrialRecord()
        for _ in range(LOOKS):
            try:
                stated, before = self._stated(), stated
            except StorageError as error:
                return [str(error)]
            found = list(self._wrong_files(stated))
            if not found or stated == before:
                break
        return found

    def _wrong_files(self, record: TrialRecord) -> Iterator[str]:
        for name, extent in record.extents.items():
            short = self._short(replace(record, committed={name: extent.length}))
            digest = None if short else digest_of(self.folder / name, extent.length)
            if short:
                yield str(short)
            elif digest is None or digest.hexdigest() != extent.sha256:
                yield f"{name} is not what was committed: its checksum differs"
        if self.spec_path.name in record.committed:
            try:
                self._read_spec()
            except StorageError as error:
                yield str(error)
        paths = {path.name: path for path in self.checkpoints()}
        if record.checkpoint and (record.status.is_finished or not self.is_mirror):
            paths[record.checkpoint] = self.checkpoints_folder / record.checkpoint
        for path in paths.values():
            try:
                self.load_checkpoint(path)
            except CheckpointError as error:
                yield str(error).removeprefix(f"{self.folder}/")

    def verified_record(self) -> TrialRecord:
        """``record``, with every file held against its digest as well."""
        record = self.record()
        found = self.damages() if record.status is not TrialState.DAMAGED else []
        return self._damaged(record, DamagedError(found[0])) if found else record

    def require_whole(self) -> None:
        """Hold every file against what was committed.

        Raises:
            DamagedError: one is damaged; the sentence says which and what to do.
        """
        record = self.verified_record()
        if record.status is TrialState.DAMAGED:
            raise DamagedError(f"{self.title}: {record.error}")

    def episodes(self) -> pd.DataFrame:
        """The committed episodes: EPISODE_COLUMNS, then cost_i and limit_i for each cost.

        This and the other readers of committed files raise DamagedError where one is not what was committed.
        """
        return self._committed_csv(self.episodes_path)

    def updates(self) -> pd.DataFrame:
        """The committed policy updates: UPDATE_COLUMNS, cost_i, limit_i, then the student's metrics."""
        return self._committed_csv(self.updates_path)

    def events(self) -> list[dict[str, Any]]:
        """The committed events, in order; each has ``update``, ``end_step`` and ``event``."""
        return [json.loads(line) for line in self.committed_bytes(self.events_path).splitlines()]

    def evaluation(self) -> pd.DataFrame:
        """The frozen-policy evaluations: EVALUATION_COLUMNS, then cost_i; empty before the end."""
        rows = self._committed_csv(self.evaluation_path)
        return rows if len(rows.columns) else pd.DataFrame(columns=list(EVALUATION_COLUMNS))

    def policy(self) -> pd.DataFrame:
        """The final policy pi(a | s): a row a state, columns action_j; empty if there is no table."""
        return self._committed_csv(self.policy_path)

    def provenance(self) -> list[dict[str, Any]]:
        """Where each attempt comes from, the first one first; none if the trial never began."""
        data = self.committed_bytes(self.provenance_path)
        if not data:
            return []
        attempts: list[dict[str, Any]] = parsed_object(data, self.provenance_path.name).get("attempts", [])
        return attempts

    def checkpoints(self) -> list[Path]:
        """The checkpoints on disk, newest first."""
        return sorted(self.checkpoints_folder.glob("checkpoint-*.recrl"), reverse=True)

    def load_checkpoint(self, path: Path) -> dict[str, Any]:
        """A checkpoint of this trial: ``trial``, the trial's state, and what its writer has to know.

        Raises:
            CheckpointError: it is missing, damaged, of another version, or of another trial.
        """
        tree = checkpoint.load(path)
        owner = tree.get("trial_id")
        if owner != self.trial_id:
            raise CheckpointError(f"{path}: the checkpoint is that of another trial, {owner}")
        return tree

    def latest_checkpoint(self) -> dict[str, Any] | None:
        """The newest intact checkpoint, or None; damaged ones are passed over."""
        for path in self.checkpoints():
            try:
                return self.load_checkpoint(path)
            except CheckpointError:
                continue
        return None

    def begin(self, spec: TrialSpec) -> TrialWriter:
        """Take the trial over: from now on only the returned writer may write.

        What is damaged is moved to ``aside/`` first.

        Args:
            spec: the trial; must be what the folder already holds, if anything.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self._clear_the_way()
            self.checkpoints_folder.mkdir(parents=True, exist_ok=True)
            return self._begin(spec)

    def _begin(self, spec: TrialSpec) -> TrialWriter:
        with self.locked():
            self.reserve_path.unlink(missing_ok=True)  # it might be a link
            self.reserve_path.write_bytes(secrets.token_bytes(RESERVE_BYTES))
            old = self._salvaged()
            if self.spec_path.name not in old.committed:
                if self.spec_path.exists():
                    self.move_aside(self.spec_path)
                write_sealed(self.spec_path, spec.to_json(), version=SPEC_FORMAT)
            extents = {**old.extents, self.spec_path.name: Extent.of(self.spec_path.read_bytes())}
            record = replace(
                old,
                **_as_fields(extents),
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
            self.write_record(record)
        return TrialWriter(self, record, spec)

    def _salvaged(self) -> TrialRecord:
        """What the next attempt goes on from: the record without the files that are not what it says.

        Those are moved aside, but for row files, of which a copy is: an older checkpoint may still do with
        their beginning.
        """
        rows = (self.episodes_path, self.updates_path, self.events_path)
        try:
            old = self._stated()
        except DamagedError as error:
            logger.warning("%s: %s; it is moved aside", self.folder.name, error)
            for path in (self.state_path, self.spec_path, self.evaluation_path, self.policy_path):
                self.move_aside(path)
            return TrialRecord(attempt=self._attempts_made())
        whole = {}
        for name, extent in old.extents.items():
            digest = digest_of(self.folder / name, extent.length)
            if digest is not None and digest.hexdigest() == extent.sha256:
                whole[name] = extent
                continue
            logger.warning("%s: %s is not what was committed; it is moved aside", self.folder.name, name)
            self.move_aside(self.folder / name, copy=self.folder / name in rows)
        return replace(old, **_as_fields(whole))

    def _attempts_made(self) -> int:
        """How many attempts there were, where the record that counted them is lost."""
        try:
            return len(parsed_object(read_whole(self.provenance_path), "")["attempts"])
        except (OSError, StorageError, KeyError, TypeError):
            return 0

    def _clear_the_way(self) -> None:
        """Move aside what is a file where a folder must be, or the other way round."""
        if self.folder.exists() and not self.folder.is_dir():
            _move_aside(self.folder, self.folder.parent.parent / "aside")
        if self.aside_folder.exists() and not self.aside_folder.is_dir():
            self.aside_folder.rename(self.folder / f"aside-{secrets.token_hex(4)}")
        for path in (self.checkpoints_folder, self.evaluations_folder, self.videos_folder):
            if path.exists() and not path.is_dir():
                self.move_aside(path)
        for path in self.folder.glob("*"):
            if path.is_dir() and path.suffix:  # the trial's own folders have none
                self.move_aside(path)
        for path in (self.folder / ".lock", self.reserve_path):
            if path.is_dir():
                self.move_aside(path)

    def move_aside(self, path: Path, *, copy: bool = False) -> None:
        """Keep a file of the trial, or what is in its place, in ``aside/``; nothing if it is not there."""
        _move_aside(path, self.aside_folder, copy=copy)

    def set_all_aside(self) -> None:
        """Move everything that attempts have left aside: the next one begins at the beginning.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self._clear_the_way()
            if not self.folder.is_dir():
                return
            with self.locked():
                kept = {self.aside_folder, self.evaluations_folder, self.videos_folder, self.folder / ".lock"}
                number = 1 + len(list(self.aside_folder.glob("run-*")))
                place = self.aside_folder / f"run-{number:03d}"
                place.mkdir(parents=True)
                for path in sorted(set(self.folder.iterdir()) - kept):
                    path.rename(place / path.name)

    def set_status(self, status: TrialState, *, error: str = "") -> None:
        """Say from outside where the trial stands, for a trial that can no longer say it itself.

        Revokes the lease of whoever still writes.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self._clear_the_way()
            self.folder.mkdir(parents=True, exist_ok=True)
            self.reserve_path.unlink(missing_ok=True)
            self._set_status(status, error)

    def _set_status(self, status: TrialState, error: str) -> None:
        with self.locked():
            try:
                stated = self._stated()
            except DamagedError:
                self.move_aside(self.state_path)
                stated = TrialRecord(attempt=self._attempts_made())
            self.write_record(replace(stated, status=status, error=error, token=""))

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
        with open_lock(self.folder / ".lock") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def committed_bytes(self, path: Path) -> bytes:
        """The committed bytes of one of the trial's files; none if nothing of it is committed.

        Raises:
            DamagedError: they are not what was committed.
        """
        stated: TrialRecord | None = None
        for _ in range(LOOKS):
            stated, before = self.stated(), stated
            extent = stated.extents.get(path.name, Extent())
            data = _head(path, extent.length)
            if Extent.of(data) == extent:
                return data
            if stated == before:
                break
        assert stated is not None
        wrong = self._short(stated) or DamagedError(
            f"{path.name} is not what was committed: its checksum differs"
        )
        raise DamagedError(f"{self.folder.name}: {self._damaged(stated, wrong).error}")

    def _committed_csv(self, path: Path) -> pd.DataFrame:
        data = self.committed_bytes(path)
        return pd.read_csv(io.BytesIO(data)) if data else pd.DataFrame()


def _head(path: Path, length: int) -> bytes:
    """A file's first bytes, fewer where it has fewer."""
    if length == 0:
        return b""
    try:
        with path.open("rb") as file:
            return file.read(length)
    except OSError:
        return b""


def _as_fields(extents: Mapping[str, Extent]) -> dict[str, Any]:
    """The fields of a TrialRecord that say what is committed."""
    return {
        "committed": {name: extent.length for name, extent in extents.items()},
        "digests": {name: extent.sha256 for name, extent in extents.items()},
    }


def _move_aside(path: Path, folder: Path, *, copy: bool = False) -> None:
    """Keep what is at a path in a folder, under a name that is free there; nothing if there is nothing."""
    if not os.path.lexists(path):
        return
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + len(list(folder.iterdir()))
    place = folder / f"{number:03d}-{path.name.lstrip('.')}"
    if copy and path.is_file():
        shutil.copy2(path, place)
    else:
        path.rename(place)


class TrialWriter:
    """The lease on a trial: buffers its rows and commits them together with a checkpoint.

    Attributes:
        store: the trial's folder.
        record: the last record this writer wrote.
    """

    def __init__(self, store: TrialStore, record: TrialRecord, spec: TrialSpec) -> None:
        self.store = store
        self.record = record
        self._agent = f"agent {spec.agent.label}"
        self._task = f"task {spec.task.label}"
        self._episodes = RowFile(store.episodes_path)
        self._updates = RowFile(store.updates_path)
        self._events = RowFile(store.events_path)
        self._rows = (self._episodes, self._updates, self._events)
        names = (store.spec_path.name, PROVENANCE)  # the rest is written anew, or taken up by ``restore``
        self._whole = {name: extent for name, extent in record.extents.items() if name in names}
        self._cpu_origin = time.process_time()
        self._cpu_before = record.cpu_seconds

    @property
    def cpu_seconds(self) -> float:
        """CPU time of all attempts of this trial so far."""
        return self._cpu_before + time.process_time() - self._cpu_origin

    def restore(self) -> dict[str, Any] | None:
        """The newest usable checkpoint, with the row files cut back to it; None to start afresh.

        A checkpoint is usable if it is intact, of this trial, and the rows that it says are there are. One
        that is not is renamed ``*.damaged`` and the one before it is used.
        """
        with self._lease():
            tree = self._newest_usable()
            if tree is None:
                for file in self._rows:
                    file.take_up(Extent())
            for file in self._rows:
                if self.record.committed.get(file.path.name, 0) > file.length:
                    self.store.move_aside(file.path, copy=True)
            self._cpu_before = float(tree["cpu_seconds"]) if tree else 0.0
            self._cpu_origin = time.process_time()
            self._write_record(
                **_as_fields(self._extents())
            )  # before the cut: nobody is to see files too short
            for file in self._rows:
                if file.path.exists():
                    os.truncate(file.path, file.length)
        return tree["trial"] if tree else None

    def _newest_usable(self) -> dict[str, Any] | None:
        """The newest usable checkpoint; all that are not are renamed."""
        found: dict[str, Any] | None = None
        for path in self.store.checkpoints():
            try:
                tree = self.store.load_checkpoint(path)
            except CheckpointError as error:
                logger.warning("%s; it is renamed", error)
            else:
                if found is not None:
                    continue
                if all(file.take_up(_extent_in(tree, file.path.name)) for file in self._rows):
                    found = tree
                    continue
                logger.warning("%s: its rows are not there any more; it is renamed", path)
            damaged = path.with_suffix(".damaged")
            if os.path.lexists(damaged):
                self.store.move_aside(damaged)
            path.rename(damaged)
        return found

    def append_episode(self, episode: EpisodeStats) -> None:
        """Add an episode's row to the next commit.

        Raises:
            RowError: it has another number of costs than those before.
        """
        costs, limits = len(episode.costs), len(episode.limits)
        if not self._episodes.has_header:
            names = (f"cost_{i}" for i in range(costs)), (f"limit_{i}" for i in range(limits))
            self._episodes.columns = (*EPISODE_COLUMNS, *names[0], *names[1])
            self._episodes.add_text(",".join(self._episodes.columns) + "\n")
        if len(EPISODE_COLUMNS) + costs + limits != len(self._episodes.columns) or costs != limits:
            raise RowError(
                f"{self._task}: an episode has {costs} costs and {limits} limits, those before it had "
                f"{len(self._episodes.columns) - len(EPISODE_COLUMNS)} together"
            )
        cells = (*_episode_values(episode), *episode.costs, *episode.limits.values)
        self._episodes.add_text(",".join(map(str, cells)) + "\n")

    def append_update(self, row: Mapping[str, Any]) -> None:
        """Add an update's row to the next commit; every row of a trial has the same keys, in any order.

        Raises:
            RowError: it has not; the sentence names the agent.
        """
        self._updates.add_row(row, of=self._agent)

    def append_event(self, event: Mapping[str, Any]) -> None:
        """Add an event's line to the next commit."""
        self._events.add_text(json.dumps(event) + "\n")

    def write_evaluation(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the frozen-policy evaluations, whole; at least one row, all with the same keys."""
        self._write_csv(self.store.evaluation_path, rows)

    def write_policy(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the final policy's table, whole: a row a state, at least one, all with the same keys."""
        self._write_csv(self.store.policy_path, rows)

    def add_provenance(self, provenance: Mapping[str, Any]) -> None:
        """Say where this attempt comes from, behind what the attempts before it said."""
        with self._lease():
            before = self.store.provenance() if PROVENANCE in self._whole else []
            if PROVENANCE not in self._whole:
                self.store.move_aside(self.store.provenance_path)
            attempts = [*before, {"attempt": self.record.attempt, **provenance}]
            write_sealed(self.store.provenance_path, {"attempts": attempts}, version=PROVENANCE_FORMAT)
            self._whole[PROVENANCE] = Extent.of(self.store.provenance_path.read_bytes())
            committed = {**self.record.extents, PROVENANCE: self._whole[PROVENANCE]}
            self._write_record(**_as_fields(committed))

    def commit(self, tree: dict[str, Any], *, update: int, env_steps: int, **changes: Any) -> None:
        """Make everything appended so far, and the trial's state, safe.

        Args:
            tree: the trial's whole state after ``update``.
            update: policy updates done.
            env_steps: environment steps taken.
            changes: further fields of the TrialRecord to set.

        Raises:
            LostLeaseError: another attempt runs the trial now; nothing was written.
            StorageError: the disk is full or gone, or a file was cut meanwhile; the previous commit stands.
        """
        with self._lease():
            written = [file.write() for file in self._rows]
            extents = {
                file.path.name: Extent(length, digest.hexdigest())
                for file, (length, digest) in zip(self._rows, written, strict=True)
            }
            cpu_seconds = self.cpu_seconds
            data = checkpoint.encode(
                {
                    "trial_id": self.store.trial_id,
                    "trial": tree,
                    "files": {name: extent.length for name, extent in extents.items()},
                    "digests": {name: extent.sha256 for name, extent in extents.items()},
                    "cpu_seconds": cpu_seconds,
                }
            )
            name = f"checkpoint-{update:08d}.recrl"
            write_atomically(self.store.checkpoints_folder / name, data)
            self._write_record(
                **_as_fields({**self._whole, **extents}),
                checkpoint=name,
                update=update,
                env_steps=env_steps,
                cpu_seconds=cpu_seconds,
                **changes,
            )
            for file, done in zip(self._rows, written, strict=True):
                file.settle(done)
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
            if self.store.stated().token != self.record.token:
                raise LostLeaseError(f"{self.store.folder.name}: another attempt runs this trial now")
            yield

    def _extents(self) -> dict[str, Extent]:
        """What is committed of every file."""
        return {**self._whole, **{file.path.name: file.extent for file in self._rows}}

    def _write_record(self, **changes: Any) -> None:
        self.record = replace(self.record, heartbeat=time.time(), **changes)
        self.store.write_record(self.record)

    def _write_csv(self, path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
        with self._lease():
            text = rows_text(rows)
            if path.exists() and path.read_bytes() != text:
                self.store.move_aside(path)
            write_atomically(path, text)
            self._whole[path.name] = Extent.of(text)


def _extent_in(tree: Mapping[str, Any], name: str) -> Extent:
    """What a checkpoint says is committed of a row file."""
    return Extent(int(tree["files"].get(name, 0)), tree["digests"].get(name, Extent().sha256))
