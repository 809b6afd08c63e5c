"""The folder of one trial: its readers' methods, and its takeover by a new attempt.

An attempt moves unusable or replaced files to ``aside/``. If the disk is full or gone, the methods raise
StorageError, and the last commit is intact.
"""

from __future__ import annotations

import logging
import os
import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

from recrl.orchestrator.errors import DamagedError, StorageError
from recrl.orchestrator.files.atomic_files import (
    parsed_object,
    read_sealed,
    read_whole,
    remove_temporary_files,
    write_atomically,
    write_sealed,
)
from recrl.orchestrator.files.locks import locked
from recrl.orchestrator.files.move_aside import move_aside, next_number
from recrl.orchestrator.files.row_files import Extent, digest_of
from recrl.orchestrator.files.trial_files import FileKind, files_of
from recrl.orchestrator.files.trial_reader import RECORD_FORMAT, SPEC_FORMAT, TrialReader
from recrl.orchestrator.files.trial_record import TrialRecord, as_fields
from recrl.orchestrator.files.trial_writer import PROVENANCE_FORMAT, TrialWriter
from recrl.orchestrator.process_scope import process_scope
from recrl.orchestrator.spec import TrialSpec, TrialStatus

RESERVE_BYTES = 16 * 1024  # room for a record and a traceback

logger = logging.getLogger("recrl.trial")


class TrialStore(TrialReader):
    """The folder of one trial: methods for readers, for writers, and for starting an attempt."""

    def write_record(self, record: TrialRecord) -> None:
        """Write ``state.json``; the caller holds ``locked``."""
        value = {"trial_id": self.trial_id, **record.to_json()}
        write_sealed(self.state_path, value, version=RECORD_FORMAT)

    def move_aside(self, path: Path, *, copy: bool = False) -> Path | None:
        """Keep a file of the trial, or what is in its place, in ``aside/``; return where, or None."""
        return move_aside(path, self.aside_folder, copy=copy)

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

    def locked(self) -> AbstractContextManager[None]:
        """Exclude other writers of this trial on the same file system, for a moment."""
        return locked(self.lock_path)

    def begin(self, spec: TrialSpec) -> TrialWriter:
        """Take over the trial: from now on only the returned writer may write.

        Damaged files are first moved to ``aside/``.

        Args:
            spec: the trial; must equal the spec in the folder, if any.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self._clear_the_way()
            self.folder.mkdir(parents=True, exist_ok=True)
            return self._begin(spec)

    def _begin(self, spec: TrialSpec) -> TrialWriter:
        with self.locked():
            self.reserve_path.unlink(missing_ok=True)  # it might be a link
            self.reserve_path.write_bytes(secrets.token_bytes(RESERVE_BYTES))
            self._set_all_aside_on_request()  # once there is room for an attempt
            self.checkpoints_folder.mkdir(exist_ok=True)
            for folder in (self.folder, self.checkpoints_folder):
                remove_temporary_files(folder)
            self.move_aside(self.error_path)  # the traceback of an earlier attempt
            old = self._salvaged()
            if self.spec_path.name not in old.committed:
                if self.spec_path.exists():
                    self.move_aside(self.spec_path)
                write_sealed(self.spec_path, spec.to_json(), version=SPEC_FORMAT)
            extents = {**old.extents, self.spec_path.name: Extent.of(self.spec_path.read_bytes())}
            record = replace(
                old,
                **as_fields(extents),
                status=TrialStatus.RUNNING,
                attempt=old.attempt + 1,
                token=secrets.token_hex(8),
                total_steps=spec.total_steps,
                started_at=old.started_at or time.time(),
                heartbeat=time.time(),
                host=socket.gethostname(),
                pid=os.getpid(),
                pid_scope=process_scope(),
                error="",
            )
            self.write_record(record)
        return TrialWriter(self, record, spec)

    def _salvaged(self) -> TrialRecord:
        """Return the starting point of the next attempt: the record without damaged files.

        Damaged files are moved aside, but row files are copied: an older checkpoint may still need their
        beginning.
        """
        rows = files_of(FileKind.ROWS)
        try:
            old = self._stored_record()
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
            if name == self.provenance_path.name and self._is_intact_provenance():
                whole[name] = Extent.of(self.provenance_path.read_bytes())
                continue
            logger.warning("%s: %s is not what was committed; it is moved aside", self.folder.name, name)
            self.move_aside(self.folder / name, copy=name in rows)
        return replace(old, **as_fields(whole))

    def _is_intact_provenance(self) -> bool:
        """Whether ``provenance.json`` is what an attempt wrote.

        An attempt that is killed right after it leaves a record with the digest of the file before.
        """
        try:
            read_sealed(self.provenance_path, version=PROVENANCE_FORMAT)
        except (OSError, StorageError):
            return False
        return True

    def _attempts_made(self) -> int:
        """Count the attempts if the record of their number is lost."""
        try:
            return len(parsed_object(read_whole(self.provenance_path), "")["attempts"])
        except (OSError, StorageError, KeyError, TypeError):
            return 0

    def _clear_the_way(self) -> None:
        """Move aside files in place of folders, folders in place of files, and links in place of rows.

        Rows are truncated and appended to, also through a link: it may lead to another file of the user.
        """
        if self.folder.exists() and not self.folder.is_dir():
            move_aside(self.folder, self.folder.parent.parent / "aside")
        if self.aside_folder.exists() and not self.aside_folder.is_dir():
            self.aside_folder.rename(self.folder / f"aside-{secrets.token_hex(4)}")
        for path in (self.checkpoints_folder, self.evaluations_folder, self.videos_folder):
            if path.exists() and not path.is_dir():
                self.move_aside(path)
        for path in self.folder.glob("*"):
            if path.is_dir() and path.suffix:  # the trial's own folders have none
                self.move_aside(path)
        for path in (self.lock_path, self.reserve_path):
            if path.is_dir():
                self.move_aside(path)
        for name in files_of(FileKind.ROWS):
            if (self.folder / name).is_symlink():
                self.move_aside(self.folder / name)

    def request_rerun(self) -> None:
        """Let the next attempt move all files of earlier ones aside, and start anew.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self._clear_the_way()
            self.folder.mkdir(parents=True, exist_ok=True)
            if not self.rerun_path.exists():
                number = next_number(self.aside_folder, "run-")
                write_atomically(self.rerun_path, f"run-{number:03d}\n".encode())

    def withdraw_rerun(self) -> None:
        """Withdraw a request of which no attempt has moved anything yet; nothing if there is none.

        Raises:
            StorageError: the disk is gone.
        """
        if self.rerun_path.exists():
            with self.writing(), self.locked():
                if not self.rerun_has_begun:
                    self.rerun_path.unlink(missing_ok=True)

    def _set_all_aside_on_request(self) -> None:
        """Move all files of earlier attempts to the folder that ``request_rerun`` named, if it was called.

        The request goes last, so that the next attempt continues after a kill. The caller holds ``locked``.
        """
        place = self.rerun_folder
        if place is None:
            return
        kept = {self.aside_folder, self.lock_path, self.rerun_path, self.reserve_path}
        place.mkdir(parents=True, exist_ok=True)
        for path in sorted(set(self.folder.iterdir()) - kept):
            path.rename(place / path.name)
        self.rerun_path.unlink()

    def set_status(self, status: TrialStatus, *, error: str = "") -> None:
        """Set the status of a trial whose process can no longer do so, or died before its attempt began.

        This revokes the lease of any writer.

        Raises:
            StorageError: the disk is full or gone.
        """
        with self.writing():
            self._clear_the_way()
            self.folder.mkdir(parents=True, exist_ok=True)
            self.reserve_path.unlink(missing_ok=True)
            self._set_status(status, error)

    def _set_status(self, status: TrialStatus, error: str) -> None:
        with self.locked():
            self._set_all_aside_on_request()
            try:
                recorded = self._stored_record()
            except DamagedError:
                self.move_aside(self.state_path)
                recorded = TrialRecord(attempt=self._attempts_made())
            self.write_record(replace(recorded, status=status, error=error, token=""))
