"""The files of a sweep, from which everything else (status, MLflow, figures) is derived.

``docs/reference/files.md`` lists all files, their columns and what each holds.

Rules. Small files are written atomically. Only ``TrialWriter.commit`` appends rows. It syncs them, then
writes a checkpoint with the files' lengths and digests, then ``state.json``. After a crash in between, a
restart truncates the files to the newest intact checkpoint, and no row is duplicated. Readers use committed
bytes only, and check them against the record's digests.

``sweep.json`` and ``trials.jsonl`` belong together if they have one creation time. So a folder may be renamed
or copied: the sweep then has the folder's name. To launch it, change ``name`` in its grid, too. A local copy
of a remote sweep must keep its name, by which ``storage.json`` finds it. In one MLflow, a copy that keeps its
name shares the runs of the original.

A file that is shorter than its committed length, or whose committed bytes have changed, is damaged. Then the
trial's status is DAMAGED and its data are not used. An attempt moves unusable or replaced files to
``aside/``.

A writer holds a lease (a token in ``state.json``). Once another attempt has taken over the trial, all its
writes are refused. If the disk is full or gone, a writer's methods raise StorageError, and the last commit is
intact.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import secrets
import shlex
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from recrl.orchestrator.errors import DamagedError, StorageError, SweepBusyError
from recrl.orchestrator.files.atomic_files import (
    read_sealed,
    read_whole,
    sealed,
    unsealed,
    write_atomically,
    write_sealed,
)
from recrl.orchestrator.files.locks import flock, look_at_lock, opened_lock
from recrl.orchestrator.files.move_aside import move_aside
from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.files.trial_files import PathIn
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec

SPECS_FORMAT = 2
INFO_FORMAT = 2
SILENCE_SECONDS = 300.0  # an update of large networks takes a minute or two
PROBE_SECONDS = 10.0  # total time for which readers may hold the lock to see whether a sweep is locked

_TRIAL = re.compile(r"__[0-9a-f]{10}$")


class SweepStore:
    """The folder of one sweep; its paths, and what the files hold.

    Attributes:
        folder: ``<root>/<sweep>``.
    """

    grid_path = PathIn("grid.yaml")
    specs_path = PathIn("trials.jsonl")
    info_path = PathIn("sweep.json")
    trials_folder = PathIn("trials")
    figures_folder = PathIn("figures")
    mlflow_database = PathIn("mlflow.db")
    mlflow_artifacts = PathIn("mlartifacts")
    sync_folder = PathIn("mlflow-sync")
    stop_request_path = PathIn("stop.request")
    storage_path = PathIn("storage.json")
    lock_path = PathIn("lock")
    aside_folder = PathIn("aside")

    def __init__(self, root: Path, name: str) -> None:
        self.folder = root.absolute() / name
        self.name = name

    def trial(self, spec: TrialSpec) -> TrialStore:
        """The trial's folder; it need not exist yet."""
        return self.trial_named(spec.folder_name)

    def trial_named(self, folder_name: str) -> TrialStore:
        """The trial in a folder of this name; it need not exist yet."""
        return TrialStore(self.trials_folder / folder_name)

    def info(self) -> dict[str, Any]:
        """Return the content of ``sweep.json``; empty if there was no launch.

        Raises:
            DamagedError: it is not what was written.
        """
        try:
            info = read_sealed(self.info_path, version=INFO_FORMAT)
            if info["name"] != self.name and self._header().get("created") not in (None, info["created"]):
                raise DamagedError(f"{self.info_path.name} is that of another sweep, {info['name']}")
            return info
        except FileNotFoundError:
            return {}
        except DamagedError as error:
            raise type(error)(f"{self.name}: {error}; launching its grid again writes it anew") from error

    @property
    def silence_seconds(self) -> float:
        """Seconds without a sign of life after which a running trial counts as dead, at least 300.

        They are those of the last launch's grid: after them its watchdog ends the trial.
        """
        try:
            return max(SILENCE_SECONDS, float(self.info().get("silence_seconds", SILENCE_SECONDS)))
        except (StorageError, TypeError, ValueError):
            return SILENCE_SECONDS

    def write_info(self, info: Mapping[str, Any]) -> None:
        """Write ``sweep.json``."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_sealed(self.info_path, info, version=INFO_FORMAT)

    def specs(self) -> list[TrialSpec]:
        """Return the trials of the last launch's grid, in order; none if there was no launch.

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
        contents = {"name": self.name, "created": self._created(), "trials": len(specs)}
        contents |= {"lines": Extent.of(lines).sha256, "grid": Extent.of(grid_text).sha256}
        header = sealed(contents, version=SPECS_FORMAT)
        if grid_text:
            write_atomically(self.grid_path, grid_text)
        write_atomically(self.specs_path, (json.dumps(header) + "\n").encode() + lines)

    def grid_text(self) -> tuple[str, str]:
        """Return the grid file of the last launch, and a sentence on its damage; either may be empty."""
        try:
            data = read_whole(self.grid_path)
        except FileNotFoundError:
            data = b""
        except StorageError as error:
            return "", f"{error}; launching the grid again writes it anew"
        try:
            expected = self._listed()[0]
        except (FileNotFoundError, StorageError):
            expected = Extent.of(data).sha256  # no other file has the grid
        if Extent.of(data).sha256 != expected:
            what = "is not what was written" if data else "is missing"
            return "", f"{self.grid_path.name} {what}; launching the grid again writes it anew"
        return data.decode(errors="replace"), ""

    def _listed(self) -> tuple[str, list[TrialSpec]]:
        """Return the digest of the grid file and the trials from ``trials.jsonl``.

        Raises:
            FileNotFoundError: it is missing.
            DamagedError: it is not what was written.
        """
        name = self.specs_path.name
        first, _, lines = read_whole(self.specs_path).partition(b"\n")
        header = unsealed(first, name, version=SPECS_FORMAT)
        if Extent.of(lines).sha256 != header["lines"]:
            raise DamagedError(f"{name} is not what was written: its checksum differs")
        created = self._created()
        both_known = created is not None and header["created"] is not None
        if header["created"] != created if both_known else header["name"] != self.name:
            raise DamagedError(f"{name} is not of this sweep, or {self.info_path.name} is not")
        try:
            return header["grid"], [TrialSpec.from_json(json.loads(line)) for line in lines.splitlines()]
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedError(f"{name} describes no trials ({error})") from error

    def _header(self) -> dict[str, Any]:
        """Return the first line of ``trials.jsonl``; empty if it is missing or damaged."""
        try:
            first = read_whole(self.specs_path).partition(b"\n")[0]
            return unsealed(first, self.specs_path.name, version=SPECS_FORMAT)
        except (FileNotFoundError, StorageError):
            return {}

    def _created(self) -> float | None:
        """Time of the sweep's first launch, seconds since 1970; None if unknown."""
        try:
            return self.info().get("created")
        except StorageError:
            return None

    def _was_launched(self) -> bool:
        try:
            info = self.info()
        except StorageError:
            return True
        return "launched" in info or (not info and bool(self.trials()))

    def damages(self) -> list[str]:
        """Return a sentence for each damaged file of the sweep itself, not of its trials."""
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
        """Return every trial on disk, in the order of the folders' names."""
        if not self.trials_folder.is_dir():
            return []
        trials = [TrialStore(path) for path in sorted(self.trials_folder.iterdir())]
        return [
            trial
            for trial in trials
            if trial.spec_path.exists()
            or trial.state_path.exists()
            or (_TRIAL.search(trial.folder.name) and not trial.folder.is_dir())  # a file instead of a folder
        ]

    def find(self, text: str) -> list[TrialStore]:
        """Return the trials on disk with this name, or else all whose name begins with it.

        Args:
            text: a trial's id, title or folder, or its beginning.
        """
        trials = self.trials()
        names = [(trial.trial_id, trial.title, trial.folder.name) for trial in trials]
        called = [trial for trial, known in zip(trials, names, strict=True) if text in known]
        begins = (any(name.startswith(text) for name in known) for known in names)
        return called or [trial for trial, fits in zip(trials, begins, strict=True) if fits]

    def is_locked(self) -> bool:
        """Whether a process runs the sweep."""
        try:
            with look_at_lock(self.lock_path) as file:
                flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return False
        return False

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the sweep's lock, so that no second process runs it.

        Raises:
            SweepBusyError: another process holds it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        for path in (self.lock_path, self.info_path, self.specs_path, self.grid_path):
            if path.is_dir():
                move_aside(path, self.aside_folder)
        if self.trials_folder.exists() and not self.trials_folder.is_dir():
            move_aside(self.trials_folder, self.aside_folder)
        with opened_lock(self.lock_path) as file:
            if not _try_lock(file):
                file.seek(0)
                holder = file.read().strip() or "another process"
                raise SweepBusyError(
                    f"{self.folder}: this sweep is already being run by {holder}; wait for it, "
                    f"or end it with: recrl-sweep stop {shlex.quote(str(self.folder))}"
                )
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
            file.flush()
            yield


def _try_lock(file: IO[str]) -> bool:
    """Try to take the exclusive lock of a file; return whether it succeeded.

    ``SweepStore.is_locked`` holds a shared lock for a moment, so it tries again for some time.
    """
    end = time.monotonic() + PROBE_SECONDS
    while True:
        try:
            flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            try:
                flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            flock(file, fcntl.LOCK_UN)
            if time.monotonic() > end:
                return False
            time.sleep(
                (1 + secrets.randbelow(10)) / 1000.0
            )  # random, so that two waiting processes do not stay in step
