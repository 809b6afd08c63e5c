"""Read a trial's spec, record, tables and checkpoints, and find damage.

A file that is shorter than its committed length, or whose committed bytes have changed, is damaged. Then the
trial's status is DAMAGED and its data are not used.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd

from recrl.orchestrator.errors import CheckpointError, DamagedError, OtherFormatError, StorageError
from recrl.orchestrator.files import checkpoint_format
from recrl.orchestrator.files.atomic_files import parsed_object, read_sealed
from recrl.orchestrator.files.row_files import NO_FILE, Extent, digest_of, shortage
from recrl.orchestrator.files.trial_files import EVALUATION_COLUMNS, TrialFiles
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.spec import TrialSpec, TrialStatus

RECORD_FORMAT = 2
SPEC_FORMAT = 2
READ_TRIES = 3  # reads of files that an attempt may be changing, before they are called damaged

Found = TypeVar("Found")


class TrialReader(TrialFiles):
    """Reader of a trial's files, checked against their commits."""

    @property
    def title(self) -> str:
        """The trial's name for people: the spec's title, or the folder's name if the spec is damaged."""
        try:
            return self.spec.title
        except StorageError:
            return self.folder.name

    @cached_property
    def spec(self) -> TrialSpec:
        """Read the trial's spec; it must be on disk.

        Raises:
            DamagedError: the file is missing, damaged or another trial's.
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
        """Read the trial's present record; a blank record if it was never started.

        The status is DAMAGED if ``state.json`` is damaged or a committed file is too short. Then ``error``
        describes damage and remedy. Digests are checked when rows are read, and by ``damages``. A local copy
        has the status also if the trial's commits in the object store cannot be used. Then no launch runs it.
        """
        try:
            recorded, wrong = self._with_findings(self._short)
        except StorageError as error:
            return self._damaged(TrialRecord(), error)
        if recorded.status is TrialStatus.DAMAGED:
            return replace(recorded, is_left_alone=True)
        return self._damaged(recorded, wrong) if wrong else recorded

    def _with_findings(self, check: Callable[[TrialRecord], Found]) -> tuple[TrialRecord, Found]:
        """Return the record, and what ``check`` finds wrong; again if the record changes meanwhile."""
        recorded = None
        for _ in range(READ_TRIES):
            recorded, before = self._stored_record(), recorded
            found = check(recorded)
            if not found or recorded == before:
                break
        assert recorded is not None
        return recorded, found

    def stored_record(self) -> TrialRecord:
        """Read ``state.json`` without a check of other files; a blank record if it is missing.

        Raises:
            DamagedError: it is not what was written.
            StorageError: it cannot be read at present.
        """
        try:
            return self._stored_record()
        except StorageError as error:
            raise type(error)(f"{self.folder.name}: {error}") from error

    def _stored_record(self) -> TrialRecord:
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

    def _short(self, record: TrialRecord) -> StorageError | None:
        """Return the problem with the lengths of the committed files, if any."""
        for name, length in record.committed.items():
            path = self.folder / name
            if length == 0 and not path.is_dir():
                continue
            try:
                found = path.stat().st_size
            except NO_FILE:
                return DamagedError(f"{name} is missing, {length:,} bytes of it are committed")
            except OSError as error:
                return StorageError(f"{name} cannot be read ({error.strerror})")
            if path.is_dir():
                return DamagedError(f"{name} is a folder, it must be a file")
            if found < length:
                return DamagedError(f"{name} {shortage(found, length)}")
        return None

    def _damaged(self, recorded: TrialRecord, error: StorageError) -> TrialRecord:
        """Return the record of a damaged trial, with a sentence on damage and remedy."""
        had_ended = recorded.attempt > 0 and recorded.status in (TrialStatus.COMPLETE, TrialStatus.FAILED)
        is_left_alone = had_ended or isinstance(error, OtherFormatError)  # its status is unknown
        is_unreadable = not isinstance(error, DamagedError)
        if is_unreadable:
            remedy = "try again when the disk can be read"
        elif self.is_local_copy:
            remedy = "the sweep's folder is only a local copy: delete it, and it is fetched again"
        elif is_left_alone:
            remedy = "launch --rerun-damaged runs the trial again and moves the damaged files aside"
        else:
            remedy = "the next launch continues from the intact files and moves the damaged ones aside"
        return replace(
            recorded,
            status=TrialStatus.DAMAGED,
            is_left_alone=is_left_alone,
            is_unreadable=is_unreadable,
            error=f"{error}; {remedy}",
        )

    def damages(self) -> list[str]:
        """Return a sentence for each file that differs from its commit, by lengths and digests.

        Empty for an intact trial, and for a trial that was never started.
        """
        return list(map(str, self._problems()))

    def _problems(self) -> list[StorageError]:
        """Return an error for each file that differs from its commit, or cannot be read."""
        try:
            return self._with_findings(lambda recorded: list(self._wrong_files(recorded)))[1]
        except StorageError as error:
            return [error]

    def _wrong_files(self, record: TrialRecord) -> Iterator[StorageError]:
        if record.status is TrialStatus.DAMAGED:
            yield DamagedError(record.error)
        for name, extent in record.extents.items():
            try:
                if short := self._short(replace(record, committed={name: extent.length})):
                    raise short
                digest = digest_of(self.folder / name, extent.length)
            except StorageError as error:
                yield error
                continue
            if digest is None or digest.hexdigest() != extent.sha256:
                yield DamagedError(f"{name} is not what was committed: its checksum differs")
        if self.spec_path.name in record.committed:
            try:
                self._read_spec()
            except StorageError as error:
                yield error
        paths = {path.name: path for path in self.checkpoints()}
        if record.checkpoint and (record.status.is_finished or not self.is_local_copy):
            paths[record.checkpoint] = self.checkpoints_folder / record.checkpoint
        for path in paths.values():
            try:
                self.load_checkpoint(path)
            except (CheckpointError, StorageError) as error:
                kind = type(error) if isinstance(error, StorageError) else DamagedError
                yield kind(str(error).removeprefix(f"{self.folder}/"))

    def verified_record(self) -> TrialRecord:
        """Return ``record``, after a check of every file's digest."""
        record = self.record()
        found = self._problems() if record.status is not TrialStatus.DAMAGED else []
        return self._damaged(record, found[0]) if found else record

    def require_whole(self) -> None:
        """Check every file against its committed digest.

        Raises:
            DamagedError: a file is damaged; the sentence names it and the remedy.
            StorageError: a file cannot be read at present; likewise.
        """
        record = self.verified_record()
        if record.status is TrialStatus.DAMAGED:
            kind = StorageError if record.is_unreadable else DamagedError
            raise kind(f"{self.title}: {record.error}")

    def committed_bytes(self, path: Path) -> bytes:
        """Read the committed bytes of one of the trial's files; empty if nothing is committed.

        Raises:
            DamagedError: they differ from the commit.
            StorageError: they cannot be read at present.
        """
        recorded: TrialRecord | None = None
        for _ in range(READ_TRIES):
            recorded, before = self.stored_record(), recorded
            extent = recorded.extents.get(path.name, Extent())
            data = _head(path, extent.length)
            if Extent.of(data) == extent:
                return data
            if recorded == before:
                break
        assert recorded is not None
        wrong = self._short(recorded) or DamagedError(
            f"{path.name} is not what was committed: its checksum differs"
        )
        raise type(wrong)(f"{self.folder.name}: {self._damaged(recorded, wrong).error}")

    def episodes(self) -> pd.DataFrame:
        """Read the committed episodes: EPISODE_COLUMNS, then cost_i and limit_i for each cost.

        This and the other readers raise the errors of ``committed_bytes``.
        """
        return self._committed_csv(self.episodes_path)

    def updates(self) -> pd.DataFrame:
        """Read the committed policy updates: UPDATE_COLUMNS, cost_i, limit_i, then the agent's metrics."""
        return self._committed_csv(self.updates_path)

    def events(self) -> list[dict[str, Any]]:
        """Read the committed events, in order; each has ``update``, ``end_step`` and ``event``."""
        return [json.loads(line) for line in self.committed_bytes(self.events_path).splitlines()]

    def evaluation(self) -> pd.DataFrame:
        """Read the final evaluations: EVALUATION_COLUMNS, then cost_i; empty before the end."""
        rows = self._committed_csv(self.evaluation_path)
        return rows if len(rows.columns) else pd.DataFrame(columns=list(EVALUATION_COLUMNS))

    def policy(self) -> pd.DataFrame:
        """Read the final policy pi(a | s): one row per state, columns action_j; empty if missing."""
        return self._committed_csv(self.policy_path)

    def provenance(self) -> list[dict[str, Any]]:
        """Read the provenance of each attempt, the first one first; empty if the trial never began."""
        data = self.committed_bytes(self.provenance_path)
        if not data:
            return []
        attempts: list[dict[str, Any]] = parsed_object(data, self.provenance_path.name).get("attempts", [])
        return attempts

    def _committed_csv(self, path: Path) -> pd.DataFrame:
        data = self.committed_bytes(path)
        return pd.read_csv(io.BytesIO(data)) if data else pd.DataFrame()

    def load_checkpoint(self, path: Path) -> dict[str, Any]:
        """Read a checkpoint of this trial: ``trial``, the trial's state, and the writer's data.

        Raises:
            CheckpointError: it is missing, damaged, of another version, or of another trial.
            StorageError: it cannot be read at present.
        """
        tree = checkpoint_format.load(path)
        owner = tree.get("trial_id")
        if owner != self.trial_id:
            raise CheckpointError(f"{path}: the checkpoint is that of another trial, {owner}")
        return tree

    def latest_checkpoint(self) -> dict[str, Any] | None:
        """Return the content of ``newest_intact``."""
        found = self.newest_intact()
        return found[1] if found else None

    def newest_intact(self) -> tuple[Path, dict[str, Any]] | None:
        """Return path and content of the newest intact checkpoint, or None; damaged ones are skipped.

        Raises:
            StorageError: a checkpoint cannot be read at present.
        """
        for path in self.checkpoints():
            try:
                return path, self.load_checkpoint(path)
            except CheckpointError:
                continue
        return None


def _head(path: Path, length: int) -> bytes:
    """Return a file's first bytes, fewer if it is shorter; none if it is missing.

    Raises:
        StorageError: it cannot be read.
    """
    if length == 0:
        return b""
    try:
        with path.open("rb") as file:
            return file.read(length)
    except NO_FILE:
        return b""
    except OSError as error:
        raise StorageError(f"{path.parent.name}: {path.name} cannot be read ({error.strerror})") from error
