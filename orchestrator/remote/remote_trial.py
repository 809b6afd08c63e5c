"""A trial in an object store: its objects, and their download to a folder.

    <address>/<sweep>/trials/<trial>/<attempt>-<token>/
        commit-<number>     record, new rows and checkpoint: see ``commit_format``
        alive.json          while the attempt works: its record, every few seconds
    <address>/<sweep>/trials/<trial>/aside/
                            commits that a later attempt did not read, below the names of their attempts

A trial runs in a folder of its machine, like any trial; ``commit_upload`` sends each commit. Rules. Readers
check the lengths and digests of a commit. A damaged one is skipped in favour of the one before it. If no
commit is intact, or the newest is of another version, the trial is DAMAGED and left alone. Every attempt
writes below its own name and depends on no other. So late writes of a node that was lost do no damage and are
not read: only the newest attempt with a commit is. An attempt starts from the newest commit of earlier ones,
so that the results are those of a trial that never moved. It makes a commit of its own, then deletes the
others; newer ones than it started from are moved to ``aside/``. An attempt that finds a newer one ends.

Trials continue while a store is down. Unsent commits are sent later, and a trial is complete when its last
commit is in the store.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import PurePosixPath
from typing import Self

from recrl.orchestrator.errors import DamagedError, OtherFormatError, StorageError
from recrl.orchestrator.files.atomic_files import write_atomically, write_json
from recrl.orchestrator.files.trial_files import FileKind, files_of
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.remote.commit_format import (
    APPENDED,
    CHECKPOINT,
    COMMIT,
    Commit,
    OtherVersionError,
    Piece,
    unpack,
)
from recrl.orchestrator.remote.object_store import ObjectStore
from recrl.orchestrator.spec import TrialStatus

COMMIT_TRIES = 3  # wait for a newer commit, before a damaged one is reported
COMMIT_PAUSE_SECONDS = 0.25  # between two of them

ALIVE = "alive.json"
ASIDE = "aside"
_ATTEMPT = re.compile(r"(\d{6})-[0-9a-f]{16}")

logger = logging.getLogger("recrl.trial")


class RemoteTrial:
    """One trial in an object store.

    Attributes:
        objects: of the trial's folder.
        name: ``TrialSpec.folder_name``.
    """

    def __init__(self, objects: ObjectStore, name: str) -> None:
        self.objects = objects
        self.name = name

    def download_for_attempt(self, trial: TrialStore) -> None:
        """Download the newest commit to an empty folder, for another attempt.

        Raises:
            DamagedError: there are commits, and none can be used; the trial must be left alone.
            StorageError: the store cannot be read, or the folder cannot be written.
        """
        with _writing(trial):
            keys = self.objects.keys_in()
            commit = self._pull(trial, keys, checkpoints=True)
            record = commit.record if commit else TrialRecord()
            begun = [int(attempt.partition("-")[0]) for attempt in attempts_in(keys)]
            # the next attempt must be the newest, even if an earlier one made no commit
            record = replace(record, attempt=max([record.attempt, *begun]))
            if record.attempt:
                trial.folder.mkdir(parents=True, exist_ok=True)
                trial.write_record(record)

    def download(self, trial: TrialStore, keys: Sequence[str] | None = None, *, checkpoints: bool) -> None:
        """Bring a folder up to the newest commit, and to the trial's progress since.

        If there are commits, and none can be used, the status there is DAMAGED. A status that this machine
        set for a running attempt (``TrialStore.set_status``) remains until the attempt records its own end,
        or a newer one begins.

        Args:
            trial: the folder; only this method and ``set_status`` write there.
            keys: of the objects in the trial's folder, if known.
            checkpoints: whether to include the checkpoint of a running trial.

        Raises:
            DamagedError: there is a link in place of the folder or of its checkpoints.
            StorageError: the store cannot be read, or the folder cannot be written.
        """
        with _writing(trial):
            self._download(trial, keys, checkpoints=checkpoints)

    def _download(self, trial: TrialStore, keys: Sequence[str] | None, *, checkpoints: bool) -> None:
        _require_no_links(trial)
        keys = self.objects.keys_in() if keys is None else keys
        attempts = attempts_in(keys)
        if not attempts:
            return
        newest = max(attempts)
        try:
            commit = self._pull(trial, keys, checkpoints=checkpoints)
        except DamagedError as error:
            _record_damage(trial, newest, error)
            return
        record = commit.record if commit else TrialRecord()
        attempt = attempt_of(record)  # the keys may be older than the commit
        works = newest > attempt or (newest == attempt and record.status is TrialStatus.RUNNING)
        if ALIVE in attempts[newest] and works:
            record = _with_life(record, self.objects.read(f"{newest}/{ALIVE}"))
        if record.attempt == 0:
            return
        trial.folder.mkdir(parents=True, exist_ok=True)
        with trial.locked():
            here = trial.record()
            silent = record.status is TrialStatus.RUNNING
            is_verdict = here.token == "" and here.status is not TrialStatus.DAMAGED
            ended_here = is_verdict and here.attempt >= record.attempt and silent
            if not ended_here and here != record:
                trial.write_record(record)

    def _pull(self, trial: TrialStore, keys: Sequence[str], *, checkpoints: bool) -> Commit | None:
        """Download the files of the newest intact commit; None if there are no commits.

        A commit that is not intact may just have been deleted in favour of a newer one. Only if that is not
        the case, the previous commit is used.

        Raises:
            OtherFormatError: the newest is of another version.
            DamagedError: none is intact.
            StorageError: the store cannot be read, or does not find an object that it lists.
        """
        for _ in range(COMMIT_TRIES - 1):
            commits = _commits(keys)
            if not commits:
                return None
            try:
                return self._pull_commit(trial, commits[0], checkpoints=checkpoints)
            except (ValueError, _MissingError):
                time.sleep(COMMIT_PAUSE_SECONDS)
                keys = self.objects.keys_in()
        return self._pull_any(trial, keys, checkpoints=checkpoints)

    def _pull_any(self, trial: TrialStore, keys: Sequence[str], *, checkpoints: bool) -> Commit | None:
        """Download the newest commit that is intact; see ``_pull``."""
        problems = []
        for key in _commits(keys):
            place = f"{self.objects.uri}/{key}"
            try:
                commit = self._pull_commit(trial, key, checkpoints=checkpoints)
            except _MissingError as error:
                if error.key in keys:
                    raise StorageError(
                        f"{self.objects.uri}/{error.key}: is listed, but not found when it is read"
                    ) from error
                problems.append(f"{place}: {error}")
            except OtherVersionError as error:
                raise OtherFormatError(
                    f"{place}: {error}; the trial is left alone: use that version, or give the sweep "
                    "another name"
                ) from error
            except ValueError as error:
                problems.append(f"{place}: {error}")
            else:
                for problem in problems:
                    logger.warning("%s; skipped", problem)
                return commit
        if problems:
            raise DamagedError(
                f"{problems[0]}; no commit of the trial is intact, so it is left alone: restore its "
                "objects, or give the sweep another name"
            )
        return None

    def _pull_commit(self, trial: TrialStore, key: str, *, checkpoints: bool) -> Commit:
        """Download the files of one commit, all or none.

        Raises:
            ValueError: it is not intact, or of another version.
            _MissingError: an object of it is not there.
        """
        before, attempt = _Pulled.of(trial), key.partition("/")[0]
        commit = before.commit if before.key == key else unpack(partial(self._read, key))
        have = before.commit.files if before.key.startswith(f"{attempt}/") else {}
        wants_checkpoint = checkpoints or commit.record.status.is_finished
        wanted = [file for file in commit.files if wants_checkpoint or not CHECKPOINT.fullmatch(file)]
        missing = {file: _missing(trial, file, commit.files[file], have.get(file)) for file in wanted}
        data = self._pieces(attempt, [piece for pieces in missing.values() for piece in pieces or ()])
        for file, pieces in missing.items():
            if pieces is not None:
                start = pieces[0].start if pieces else 0
                _write_at(trial, file, start, b"".join(data[piece] for piece in pieces))
        for file in before.commit.files.keys() - commit.files.keys():
            if not CHECKPOINT.fullmatch(file):  # of an attempt before: its traceback, for example
                (trial.folder / file).unlink(missing_ok=True)
        if any(CHECKPOINT.fullmatch(file) for file in wanted):
            for path in trial.checkpoints():
                if f"checkpoints/{path.name}" not in wanted:  # of another commit: its rows are not here
                    path.unlink()
        if before.key != key:
            _Pulled(key, commit).write(trial)
        return commit

    def _pieces(self, attempt: str, pieces: Sequence[Piece]) -> dict[Piece, bytes]:
        """Return the bytes of pieces, each object read once; raise the errors of ``_pull_commit``."""
        found: dict[Piece, bytes] = {}
        for commit in {piece.commit for piece in pieces}:
            own = [piece for piece in pieces if piece.commit == commit]
            begin = min(piece.offset for piece in own)
            end = max(piece.offset + piece.length for piece in own)
            data = self._read(f"{attempt}/{commit}", begin, end)
            for piece in own:
                at = piece.offset - begin
                found[piece] = data[at : at + piece.length]
                if hashlib.sha256(found[piece]).hexdigest() != piece.sha256:
                    raise ValueError(f"its bytes in {commit} are not intact")
        return found

    def _read(self, key: str, start: int, end: int) -> bytes:
        data = self.objects.read_range(key, start, end)
        if data is None:
            raise _MissingError(key)
        return data


class _MissingError(Exception):
    """An object of a commit is not there.

    Attributes:
        key: of the object.
    """

    def __init__(self, key: str) -> None:
        super().__init__(f"{key} is missing")
        self.key = key


@dataclass(frozen=True)
class _Pulled:
    """The commit that was last downloaded to a folder.

    Attributes:
        key: of the commit; empty if there was none.
        commit: the commit.
    """

    key: str
    commit: Commit

    @classmethod
    def of(cls, trial: TrialStore) -> Self:
        """Read it from the folder."""
        try:
            value = json.loads(trial.pulled_path.read_text())
            return cls(str(value["key"]), Commit.from_json(value["commit"]))
        except (OSError, ValueError, KeyError, TypeError):
            return cls("", Commit(TrialRecord(), {}))

    def write(self, trial: TrialStore) -> None:
        """Store it in the folder."""
        trial.folder.mkdir(parents=True, exist_ok=True)
        write_json(trial.pulled_path, {"key": self.key, "commit": self.commit.to_json()})


def pulled_key(trial: TrialStore) -> str:
    """Return the key of the commit that was last downloaded to a folder; empty if there was none."""
    return _Pulled.of(trial).key


def _record_damage(trial: TrialStore, newest: str, error: DamagedError) -> None:
    """Set the status in a folder to DAMAGED, because no commit can be used; other fields remain.

    Args:
        trial: the folder.
        newest: name of the newest attempt.
        error: the damage, and what to do.
    """
    trial.folder.mkdir(parents=True, exist_ok=True)
    with trial.locked():
        here = trial.record()
        attempt = max(here.attempt, int(newest.partition("-")[0]))
        record = replace(here, status=TrialStatus.DAMAGED, attempt=attempt, error=str(error))
        if record != here:
            trial.write_record(record)


def _missing(
    trial: TrialStore, file: str, pieces: tuple[Piece, ...], have: tuple[Piece, ...] | None
) -> list[Piece] | None:
    """Return the pieces of a file that are missing in a folder; None if it is complete.

    Args:
        trial: the folder.
        file: its path in the folder.
        pieces: of the complete file.
        have: the present pieces of the same attempt; None if the file is of another attempt.
    """
    is_file = (trial.folder / file).is_file() and not (trial.folder / file).is_symlink()
    size = size_of(trial, file) if is_file else 0
    if have is not None and _same(have, pieces) and is_file and size >= _length(pieces):
        return None
    known = _length(have) if have and file in APPENDED else 0
    missing = [piece for piece in pieces if piece.end > (known if size >= known else 0)]
    return None if pieces and not missing else missing


def _same(some: Sequence[Piece], others: Sequence[Piece]) -> bool:
    """Return whether two lists of pieces, possibly in different objects, are the same bytes."""

    def content(pieces: Sequence[Piece]) -> list[tuple[int, str]]:
        return [(piece.start, piece.sha256) for piece in pieces]

    return content(some) == content(others)


def attempts_in(keys: Sequence[str]) -> dict[str, list[str]]:
    """Return the keys below each attempt; the names of attempts are in the order of their age."""
    found: dict[str, list[str]] = {}
    for key in keys:
        attempt, _, name = key.partition("/")
        if _ATTEMPT.fullmatch(attempt) and name:
            found.setdefault(attempt, []).append(name)
    return found


def _commits(keys: Sequence[str]) -> list[str]:
    """Return the keys of all commits: the newest attempt first, and its newest commit first."""
    found = [
        f"{attempt}/{name}"
        for attempt, names in attempts_in(keys).items()
        for name in filter(COMMIT.fullmatch, names)
    ]
    return sorted(found, reverse=True)


def attempt_of(record: TrialRecord) -> str:
    """Return the name of a record's attempt."""
    return f"{record.attempt:06d}-{record.token}"


def _with_life(record: TrialRecord, sign: bytes | None) -> TrialRecord:
    """Return the record of the last commit with the newer sign of life, except for committed extents."""
    try:
        alive = TrialRecord.from_json(json.loads(sign or b"null"))
    except (ValueError, KeyError, TypeError):
        return record  # it was deleted or truncated: a newer one will follow
    if alive.token == record.token and alive.heartbeat < record.heartbeat:
        return record
    return replace(alive, committed=record.committed, digests=record.digests, checkpoint=record.checkpoint)


def _require_no_links(trial: TrialStore) -> None:
    """Check that a trial's folder, the one around it, and its checkpoints' are no symbolic links.

    A folder that was received might otherwise lead a download to other files of the user.

    Raises:
        DamagedError: one of them is a link.
    """
    for path in (trial.folder.parent, trial.folder, trial.checkpoints_folder):
        if path.is_symlink():
            raise DamagedError(f"{path}: is a link, it must be a folder; delete it, and it is fetched again")


@contextmanager
def _writing(trial: TrialStore) -> Iterator[None]:
    """Turn an error of this machine's disk into a StorageError, which is waited for.

    Raises:
        StorageError: there was one.
    """
    try:
        yield
    except OSError as error:
        raise StorageError(f"{trial.folder}: cannot be written ({error.strerror or error})") from error


def _write_at(trial: TrialStore, name: str, start: int, data: bytes) -> None:
    """Append bytes to a file, or replace the whole file, and a link in its place.

    Raises:
        DamagedError: there is a link in place of the file to append to.
        StorageError: the name is not that of a file that trials have.
    """
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise StorageError(f"{trial.folder}: its object names a file outside it: {name!r}")
    if name in files_of(FileKind.LOCAL):
        raise StorageError(f"{trial.folder}: its object names a file of the machine's own: {name!r}")
    path = trial.folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if start == 0:
        write_atomically(path, data)
        return
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_NOFOLLOW)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise DamagedError(
            f"{path}: is a link, it must be a file; delete it, and it is fetched again"
        ) from error
    with os.fdopen(descriptor, "wb") as file:
        file.seek(start)
        file.write(data)


def _length(pieces: Sequence[Piece]) -> int:
    return pieces[-1].end if pieces else 0


def size_of(trial: TrialStore, name: str) -> int:
    """Return the size of a file in a trial's folder, 0 if it is missing."""
    path = trial.folder / name
    return path.stat().st_size if path.exists() else 0
