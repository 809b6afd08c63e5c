"""Upload the commits of an attempt at a trial to the object store."""

from __future__ import annotations

import json
import logging
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import LostLeaseError, StorageError
from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.trial_files import FileKind, files_of
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.remote import retries
from recrl.orchestrator.remote.commit_format import APPENDED, COMMIT, WHOLE, Commit, Piece, pack
from recrl.orchestrator.remote.remote_trial import (
    ALIVE,
    ASIDE,
    RemoteTrial,
    attempt_of,
    attempts_in,
    pulled_key,
    size_of,
)
from recrl.orchestrator.remote.retries import retry_while_down
from recrl.orchestrator.spec import TrialSpec, TrialStatus

FOLDER_CHECK_SECONDS = 0.5  # between two checks of the trial's folder
ALIVE_SECONDS = 15.0  # between two heartbeats
KEPT_COMMITS = 2  # a reader may still use the last but one

logger = logging.getLogger("recrl.trial")


class Upload:
    """Upload of an attempt from its folder to the store."""

    def __init__(self, remote: RemoteTrial, trial: TrialStore) -> None:
        """Prepare the upload of the next attempt (``TrialStore.begin``).

        Args:
            remote: the target.
            trial: the source, after ``RemoteTrial.download_for_attempt``.
        """
        self._remote = remote
        self._trial = trial
        self._before = trial.stored_record().token
        self._started_from = pulled_key(trial)
        self._commits: list[tuple[str, Commit]] = []
        self._written: set[str] = set()
        self._number = 0
        self._shown: tuple[Any, ...] | None = None
        self._heartbeat_sent = float("-inf")
        self._sending = threading.Lock()  # a signal may end the wait for the thread that follows

    def follow(self) -> None:
        """Send new commits, if any, and regularly a heartbeat.

        Raises:
            StorageError: the store cannot be written; nothing is lost, the next call tries again.
            LostLeaseError: a newer attempt runs the trial.
        """
        with self._sending:
            record = self._own_record()
            if record is None:
                return
            if self._shown is None or time.monotonic() >= self._heartbeat_sent + ALIVE_SECONDS:
                self._send_heartbeat(record)
            if self._shown != _commit_of(record):
                self.push()

    def finish(self) -> None:
        """Send the remaining commits, after the attempt's end; raise the errors of ``follow``."""
        with self._sending:
            record = self._own_record()
            if record is None:
                return
            self._send_heartbeat(replace(record, heartbeat=time.time()))  # uploads may take long
            self.push()
            self._remote.objects.delete([f"{attempt_of(record)}/{ALIVE}"])

    def _own_record(self) -> TrialRecord | None:
        """Return the record of the attempt to upload; None before it has begun."""
        record = self._trial.stored_record()
        return None if record.token in ("", self._before) else record

    def push(self) -> None:
        """Send a commit of the present files.

        Raises:
            StorageError: the store cannot be written; the previous commit is intact.
            LostLeaseError: a newer attempt runs the trial.
        """
        record, kept, new = self._capture()
        attempt = attempt_of(record)
        others = self._other_attempts(attempt)
        self._number += 1  # also if this fails: a reader may have it, so names are not reused
        name = f"commit-{self._number:08d}"
        commit, data = pack(name, record, kept, new)
        self._written.add(name)
        self._write(f"{attempt}/{name}", data)
        self._shown = _commit_of(record)
        self._commits = [*self._commits, (name, commit)][-KEPT_COMMITS:]
        self._clear(attempt, others)

    def revoke(self) -> None:
        """Revoke the trial's lease, so that its attempt ends."""
        self._trial.set_status(TrialStatus.WAITING)

    def _write(self, key: str, data: bytes) -> None:
        """Write a commit's object; if that fails, delete what was written of it, if the store lets us."""
        try:
            self._remote.objects.write(key, data)
        except StorageError:
            with suppress(StorageError):
                if self._remote.objects.read(key) != data:
                    self._remote.objects.delete([key])
            raise

    def _send_heartbeat(self, record: TrialRecord) -> None:
        """Send a heartbeat. Only a commit may record the end."""
        alive = replace(record, status=TrialStatus.RUNNING)
        self._remote.objects.write(f"{attempt_of(record)}/{ALIVE}", _json(alive.to_json()))
        self._heartbeat_sent = time.monotonic()

    def _capture(self) -> tuple[TrialRecord, dict[str, tuple[Piece, ...]], dict[str, tuple[int, bytes]]]:
        """Return the record, the sent pieces and the new bytes; holds the trial's lock.

        The rows are those of the newest checkpoint: if a full disk interrupted a commit, the record may be
        older.
        """
        with self._trial.locked():
            record = self._trial.stored_record()
            saved, rows = _newest_checkpoint(self._trial)
            extents = {**record.extents, **dict.fromkeys(files_of(FileKind.ROWS), Extent()), **rows}
            committed = {name: extent.length for name, extent in extents.items()}
            logs = {name: size_of(self._trial, name) for name in files_of(FileKind.LOG)}
            lengths = {**committed, **logs}
            kept: dict[str, tuple[Piece, ...]] = {}
            new: dict[str, tuple[int, bytes]] = {}
            for name in APPENDED:
                if (self._trial.folder / name).exists():
                    kept[name], start = self._kept(name, lengths.get(name, 0))
                    self._take(name, start, lengths.get(name, 0), new)
            for name in (*WHOLE, *saved):
                if (self._trial.folder / name).exists():
                    kept[name] = ()
                    self._take(name, 0, size_of(self._trial, name), new)
        digests = {name: extent.sha256 for name, extent in extents.items()}
        return replace(record, committed=committed, digests=digests), kept, new

    def _take(self, name: str, start: int, end: int, new: dict[str, tuple[int, bytes]]) -> None:
        if end > start:
            with (self._trial.folder / name).open("rb") as file:
                file.seek(start)
                new[name] = (start, file.read(end - start))

    def _kept(self, name: str, length: int) -> tuple[tuple[Piece, ...], int]:
        """Return the kept pieces of a row file, and the offset of the bytes to send.

        A new piece includes earlier ones that are not longer. So n commits leave about log2(n) pieces, and
        each byte is sent at most about log2(n) times.
        """
        pieces = list(self._commits[-1][1].files.get(name, ())) if self._commits else []
        if pieces and pieces[-1].end > length:  # truncated: not the sent bytes
            pieces.clear()
        start = pieces[-1].end if pieces else 0
        if start < length:
            while pieces and pieces[-1].length <= length - start:
                start = pieces.pop().start
        return tuple(pieces), start

    def _other_attempts(self, attempt: str) -> list[str]:
        """Return the keys of the attempts before this one."""
        others = attempts_in(self._remote.objects.keys_in())
        if max(others, default="") > attempt:
            raise LostLeaseError(f"{self._remote.name}: another attempt runs this trial now")
        return [f"{other}/{name}" for other, names in others.items() if other != attempt for name in names]

    def _clear(self, attempt: str, others: Sequence[str]) -> None:
        """Delete objects that the last commits do not need, and earlier attempts.

        Commits of earlier attempts that are newer than the start of this attempt were not read: they are
        damaged or came later. They are kept aside.
        """
        spare = self._written.difference(*({name, *commit.objects} for name, commit in self._commits))
        unread = [key for key in others if _is_commit(key) and key > self._started_from]
        for key in unread:
            self._keep_aside(key)
        old = [f"{attempt}/{name}" for name in sorted(spare, reverse=True)]
        self._remote.objects.delete([*old, *(key for key in others if key not in unread)])
        self._written -= spare

    def _keep_aside(self, key: str) -> None:
        data = self._remote.objects.read(key)
        if data is not None:
            self._remote.objects.write(f"{ASIDE}/{key}", data)
            self._remote.objects.delete([key])


@contextmanager
def working_copy(
    remote: RemoteTrial, spec: TrialSpec, should_stop: Callable[[], bool]
) -> Iterator[TrialStore]:
    """Yield a folder on this machine for one attempt at a trial in an object store.

    It contains the files of earlier attempts. Commits of the body are uploaded meanwhile, the remaining ones
    at the end.

    Args:
        remote: the trial in the store.
        spec: the trial.
        should_stop: once true, the wait for a store that is down is at most ``STOPPING_SECONDS``. If the body
            ends with SystemExit, there is none.

    Raises:
        DamagedError: the store has commits of the trial, and none can be used.
        StorageError: the store was down for ``RETRY_SECONDS``, or this machine's disk is full; the store's
            last commit is intact.
    """
    with _scratch(tempfile.gettempdir()) as folder:
        trial = TrialStore(folder / spec.folder_name)
        retry_while_down(lambda: remote.download_for_attempt(trial), should_stop)
        upload = Upload(remote, trial)
        try:
            try:
                with background_thread(partial(_follow, upload), name="upload"):
                    yield trial
            except Exception:  # but not a KeyboardInterrupt, which ends at once
                _finish(upload, should_stop)
                raise
            _finish(upload, should_stop)
        except SystemExit:  # SIGTERM outside of the trial
            with suppress(StorageError, LostLeaseError):
                upload.finish()
            raise


@contextmanager
def _scratch(parent: str) -> Iterator[Path]:
    """Make a ``scratch_folder``.

    Raises:
        StorageError: there is no room for one.
    """
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(scratch_folder(parent))
        except OSError as error:
            raise StorageError(f"{parent}: cannot be written ({error.strerror or error})") from error
        yield folder


def _finish(upload: Upload, should_stop: Callable[[], bool]) -> None:
    """Send the remaining commits, unless there is a newer attempt."""
    try:
        retry_while_down(upload.finish, should_stop)
    except LostLeaseError as error:
        logger.warning("%s", error)


def _follow(upload: Upload, over: threading.Event) -> None:
    """Send commits until the end."""
    hint = "the trial continues, and the upload is tried again"
    try:
        retries.repeat_until(upload.follow, over, every=FOLDER_CHECK_SECONDS, hint=hint)
    except LostLeaseError as error:
        logger.warning("%s", error)
        upload.revoke()


def _is_commit(key: str) -> bool:
    return COMMIT.fullmatch(key.rpartition("/")[2]) is not None


def _commit_of(record: TrialRecord) -> tuple[Any, ...]:
    """Return the fields of a record that change only with a commit, a beginning or an end."""
    return (record.token, record.status, record.error, record.cpu_seconds, *sorted(record.committed.items()))


def _newest_checkpoint(trial: TrialStore) -> tuple[list[str], dict[str, Extent]]:
    """Return the newest intact checkpoint, as a path in the trial's folder, if any, and its rows' extents."""
    found = trial.newest_intact()
    if found is None:
        return [], {}
    path, tree = found
    rows = {name: Extent(length, tree["digests"][name]) for name, length in tree["files"].items()}
    return [f"checkpoints/{path.name}"], rows


def _json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
