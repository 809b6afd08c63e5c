"""A trial that is kept in an object store: its way there, attempt by attempt, and its way back.

    <address>/<sweep>/trials/<trial>/<attempt>-<token>/
        parts/<file>.<first byte>.<sum>     a run of bytes of one of the trial's files
        manifest-<number>.json              a TrialRecord, and of which parts each file is made
        alive.json                          while the attempt works: its record, every few seconds

A trial works in a folder of the machine that it runs on, as any trial does (``store`` has the files and
their rules). Beside it, this takes what each commit changed to the store: new bytes of the row files and the
new checkpoint first, then a manifest. Rules. Readers believe manifests, and of a manifest only what its
lengths and sums confirm: what was cut short is not there. Every attempt writes below its own name and
depends on no other, so what a node writes that comes back from the dead damages nobody, and is not read:
only the newest attempt with a manifest is. An attempt begins with the newest manifest of those before it,
which gives the bytes of a trial that never moved, and says so by a manifest of its own; then it clears away
the others. An attempt that finds a newer one ends itself.

A store that is down stops no trial: what could not be sent is sent later, and a trial is complete when its
last manifest is there.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import PurePosixPath
from typing import Any, Self

from recrl.orchestrator.background import beside
from recrl.orchestrator.errors import CheckpointError, LostLeaseError, StorageError
from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.small_files import write_atomically, write_json
from recrl.orchestrator.files.store import TrialRecord, TrialStore
from recrl.orchestrator.remote.object_store import ObjectStore
from recrl.orchestrator.spec import TrialSpec, TrialState

FORMAT = 1
LOOK_SECONDS = 0.5  # between two looks at the trial's folder
ALIVE_SECONDS = 15.0  # between two signs of life
FIRST_PAUSE_SECONDS = 1.0  # before a failed upload is tried again; doubled each time
LONGEST_PAUSE_SECONDS = 60.0
PATIENCE_SECONDS = 900.0  # for a store that is down when a trial begins or has ended
STOPPING_SECONDS = 60.0  # the same, once the sweep is to stop
KEPT_MANIFESTS = 2  # a reader may still be at the one before the last
RETRIES = 3  # looks for a newer manifest, before one that is not intact is called damaged

APPENDED = ("episodes.csv", "updates.csv", "events.jsonl", "log.txt")
ROWS = ("episodes.csv", "updates.csv", "events.jsonl")
WHOLE = ("spec.json", "provenance.json", "error.txt", "evaluation.csv", "policy.csv")
ALIVE = "alive.json"
PULLED = ".pulled.json"
_CHECKPOINT = re.compile(r"checkpoints/checkpoint-\d{8}\.recrl")
_ATTEMPT = re.compile(r"(\d{6})-[0-9a-f]{16}")
_MANIFEST = re.compile(r"manifest-\d{8}\.json")

logger = logging.getLogger("recrl.trial")


@dataclass(frozen=True)
class Part:
    """A run of bytes of a file, which is one object.

    Attributes:
        key: of the object, below the attempt.
        start: of its first byte in the file.
        length: bytes, at least 1.
        sha256: of them, in hex.
    """

    key: str
    start: int
    length: int
    sha256: str

    @classmethod
    def of(cls, name: str, start: int, data: bytes) -> Self:
        """The part of a file that these bytes are."""
        digest = hashlib.sha256(data).hexdigest()
        return cls(f"parts/{name.rpartition('/')[2]}.{start}.{digest[:16]}", start, len(data), digest)

    @property
    def end(self) -> int:
        """The byte after its last one."""
        return self.start + self.length


@dataclass(frozen=True)
class Manifest:
    """A set of files that belong together.

    Attributes:
        record: where the trial stood.
        files: the parts of each file without a gap, by its path in the trial's folder.
    """

    record: TrialRecord
    files: Mapping[str, tuple[Part, ...]]

    @property
    def keys(self) -> frozenset[str]:
        """Of all its parts."""
        return frozenset(part.key for parts in self.files.values() for part in parts)

    def to_bytes(self) -> bytes:
        """Strict JSON; ``from_bytes`` is its inverse."""
        files = {name: [asdict(part) for part in parts] for name, parts in self.files.items()}
        value = {"format": FORMAT, "record": self.record.to_json(), "files": files}
        return json.dumps(value, indent=1, allow_nan=False).encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """What ``to_bytes`` wrote.

        Raises:
            ValueError: the bytes are no manifest of this version, or a part of one.
        """
        try:
            value = json.loads(data)
            if value["format"] != FORMAT:
                raise ValueError(f"a manifest of format {FORMAT} is expected, got {value['format']!r}")
            files = {name: tuple(Part(**part) for part in parts) for name, parts in value["files"].items()}
            manifest = cls(TrialRecord.from_json(value["record"]), files)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no manifest: {error}") from error
        for name, parts in files.items():
            if name not in (*APPENDED, *WHOLE) and not _CHECKPOINT.fullmatch(name):
                raise ValueError(f"a manifest names a file that no trial has: {name!r}")
            if [part.start for part in parts] != [0, *(part.end for part in parts)][:-1]:
                raise ValueError(f"a manifest's parts of {name} leave a gap")
        return manifest


class RemoteTrial:
    """One trial in an object store.

    Attributes:
        name: ``TrialSpec.folder_name``.
    """

    def __init__(self, objects: ObjectStore, name: str) -> None:
        """Look at nothing yet.

        Args:
            objects: what lies below the trial's folder.
            name: the folder's.
        """
        self.objects = objects
        self.name = name

    def take_up(self, trial: TrialStore) -> None:
        """Bring what the newest manifest names into an empty folder, for another attempt.

        Raises:
            StorageError: the store cannot be read.
        """
        keys = self.objects.keys_in()
        manifest = self._pull(trial, keys, checkpoints=True)
        record = manifest.record if manifest else TrialRecord()
        begun = [int(attempt.partition("-")[0]) for attempt in _attempts(keys)]
        # the next attempt is to be the newest, also where one before it never came to a manifest
        record = replace(record, attempt=max([record.attempt, *begun]))
        if record.attempt:
            trial.folder.mkdir(parents=True, exist_ok=True)
            trial.write_record(record)

    def mirror(self, trial: TrialStore, keys: Sequence[str] | None = None, *, checkpoints: bool) -> None:
        """Make a folder show the newest manifest, and how far the trial has come since.

        What was said here of a running attempt from outside (``TrialStore.set_status``) stands until that one
        says itself how it ended, or a newer one begins.

        Args:
            trial: the folder; only this ever writes there, but for ``set_status``.
            keys: what there is below the trial's folder, if that is known.
            checkpoints: whether to bring the checkpoint of a trial that still runs.

        Raises:
            StorageError: the store cannot be read.
        """
        keys = self.objects.keys_in() if keys is None else keys
        attempts = _attempts(keys)
        if not attempts:
            return
        manifest = self._pull(trial, keys, checkpoints=checkpoints)
        record = manifest.record if manifest else TrialRecord()
        newest, told = max(attempts), _attempt_of(record)  # the keys may be older than the manifest
        works = newest > told or (newest == told and record.status is TrialState.RUNNING)
        if ALIVE in attempts[newest] and works:
            record = _with_life(record, self.objects.read(f"{newest}/{ALIVE}"))
        if record.attempt == 0:
            return
        trial.folder.mkdir(parents=True, exist_ok=True)
        with trial.locked():
            here = trial.record()
            silent = record.status is TrialState.RUNNING
            judged = here.token == "" and here.attempt >= record.attempt and silent
            if not judged and here != record:
                trial.write_record(record)

    def _pull(self, trial: TrialStore, keys: Sequence[str], *, checkpoints: bool) -> Manifest | None:
        """Bring the files of the newest intact manifest; None if there is none.

        One that is not intact may have been cleared away meanwhile, because there is a newer one: only
        where that is not so, it is passed over for the one before it.
        """
        for tries_left in range(RETRIES - 1, -1, -1):
            manifests = _manifests(keys)
            for place in manifests if tries_left == 0 else manifests[:1]:
                try:
                    return self._pull_manifest(trial, place, checkpoints=checkpoints)
                except ValueError as error:
                    if tries_left == 0:
                        logger.warning("%s/%s: passed over: %s", self.objects.uri, place, error)
            if not manifests:
                return None
            keys = self.objects.keys_in()
        return None

    def _pull_manifest(self, trial: TrialStore, place: str, *, checkpoints: bool) -> Manifest:
        """Bring the files of one manifest, all or none; ValueError if it is not intact."""
        before, attempt = _Pulled.of(trial), place.partition("/")[0]
        manifest = before.manifest if before.place == place else self._manifest(place)
        have = before.manifest.files if before.place.startswith(f"{attempt}/") else {}
        wants_checkpoint = checkpoints or manifest.record.status.is_finished
        news = {
            file: self._news(trial, attempt, file, parts, have.get(file))
            for file, parts in manifest.files.items()
            if wants_checkpoint or not _CHECKPOINT.fullmatch(file)
        }
        for file, new in news.items():
            if new is not None:
                _place(trial, file, *new)
        if any(_CHECKPOINT.fullmatch(file) for file in news):
            for path in trial.checkpoints():
                if f"checkpoints/{path.name}" not in news:  # of another manifest: its rows are not here
                    path.unlink()
        if before.place != place:
            _Pulled(place, manifest).write(trial)
        return manifest

    def _manifest(self, key: str) -> Manifest:
        """A manifest that is there; ValueError if it is not intact."""
        return Manifest.from_bytes(self.objects.read(key) or b"")

    def _news(
        self,
        trial: TrialStore,
        attempt: str,
        file: str,
        parts: tuple[Part, ...],
        have: tuple[Part, ...] | None,
    ) -> tuple[int, bytes] | None:
        """The bytes of a file that a folder lacks, and where they begin; None if it lacks none.

        Args:
            trial: the folder.
            attempt: whose the file is.
            file: its path in the folder.
            parts: of which it is to be made.
            have: of which it is made, as the same attempt left it; None if it is not of that attempt.

        Raises:
            ValueError: a part is not what the manifest says.
        """
        size, length = _size(trial, file), _length(parts)
        if parts == have and size >= length and (trial.folder / file).exists():
            return None
        known = _length(have) if have and file in APPENDED else 0
        missing = [part for part in parts if part.end > (known if size >= known else 0)]
        if parts and not missing:
            return None
        data = b"".join(self._part(attempt, part) for part in missing)
        return (missing[0].start if missing else 0, data)

    def _part(self, attempt: str, part: Part) -> bytes:
        """A part's bytes; ValueError if they are not what the manifest says."""
        data = self.objects.read(f"{attempt}/{part.key}") or b""
        if hashlib.sha256(data).hexdigest() != part.sha256:
            raise ValueError(f"{part.key} is not intact")
        return data


@dataclass(frozen=True)
class _Pulled:
    """What was last brought into a folder.

    Attributes:
        place: the manifest's key; empty if there was none.
        manifest: itself.
    """

    place: str
    manifest: Manifest

    @classmethod
    def of(cls, trial: TrialStore) -> Self:
        """As the folder remembers it."""
        try:
            value = json.loads((trial.folder / PULLED).read_text())
            return cls(value["place"], Manifest.from_bytes(value["manifest"].encode()))
        except (OSError, ValueError, KeyError, TypeError):
            return cls("", Manifest(TrialRecord(), {}))

    def write(self, trial: TrialStore) -> None:
        """Remember it."""
        trial.folder.mkdir(parents=True, exist_ok=True)
        value = {"place": self.place, "manifest": self.manifest.to_bytes().decode()}
        write_json(trial.folder / PULLED, value)


class Upload:
    """An attempt's way from the folder in which it works to the store."""

    def __init__(self, remote: RemoteTrial, trial: TrialStore) -> None:
        """Begin with whatever attempt takes the trial next (``TrialStore.begin``).

        Args:
            remote: where to.
            trial: where from; as ``RemoteTrial.take_up`` left it.
        """
        self._remote = remote
        self._trial = trial
        self._before = trial.stated().token
        self._parts: Mapping[str, tuple[Part, ...]] = {}
        self._manifests: list[tuple[str, Manifest]] = []
        self._written: set[str] = set()
        self._number = 0
        self._shown: tuple[Any, ...] | None = None
        self._spoke_at = float("-inf")

    def follow(self) -> None:
        """Send what is new, if anything is, and now and then a sign of life.

        Raises:
            StorageError: the store cannot be written; nothing is lost, the next call tries again.
            LostLeaseError: a newer attempt runs the trial.
        """
        record = self._trial.stated()
        if not record.token or record.token == self._before:
            return
        if self._shown is None or time.monotonic() >= self._spoke_at + ALIVE_SECONDS:
            self._speak(record)
        if self._shown != _commit_of(record):
            self.push()

    def finish(self) -> None:
        """Send the rest, after the attempt's end.

        Raises:
            StorageError: the store cannot be written; nothing is lost, the next call tries again.
            LostLeaseError: a newer attempt runs the trial.
        """
        record = self._trial.stated()
        if not record.token or record.token == self._before:
            return
        self._speak(replace(record, heartbeat=time.time()))  # to send much takes long
        self.push()
        self._remote.objects.delete([f"{_attempt_of(record)}/{ALIVE}"])

    def push(self) -> None:
        """Send a set of files as of this moment, and name it by a manifest.

        Raises:
            StorageError: the store cannot be written; the manifest before stands.
            LostLeaseError: a newer attempt runs the trial.
        """
        record, manifest, data = self._capture()
        attempt = _attempt_of(record)
        others = self._other_attempts(attempt)
        for key, piece in data.items():
            if key not in self._written:
                self._remote.objects.write(f"{attempt}/{key}", piece)
                self._written.add(key)
        self._number += 1  # also if this fails: a reader may have it, and looks at no name a second time
        name = f"manifest-{self._number:08d}.json"
        self._written.add(name)
        self._remote.objects.write(f"{attempt}/{name}", manifest.to_bytes())
        self._parts, self._shown = manifest.files, _commit_of(record)
        self._manifests.append((name, manifest))
        self._clear(attempt, others)

    def revoke(self) -> None:
        """Take the trial's lease back, so that its attempt ends."""
        self._trial.set_status(TrialState.WAITING)

    def _speak(self, record: TrialRecord) -> None:
        """Claim the trial, and say that it lives. That it is over only a manifest may say."""
        said = replace(record, status=TrialState.RUNNING)
        self._remote.objects.write(f"{_attempt_of(record)}/{ALIVE}", _json(said.to_json()))
        self._spoke_at = time.monotonic()

    def _capture(self) -> tuple[TrialRecord, Manifest, dict[str, bytes]]:
        """The record, what belongs to it, and the bytes of the new parts, while nobody commits.

        The rows are those of the newest checkpoint: of a commit that a full disk broke off, the record may
        not know yet.
        """
        data: dict[str, bytes] = {}
        parts: dict[str, tuple[Part, ...]] = {}
        with self._trial.locked():
            record = self._trial.stated()
            saved, rows = _newest_checkpoint(self._trial)
            extents = {**record.extents, **dict.fromkeys(ROWS, Extent()), **rows}
            committed = {name: extent.length for name, extent in extents.items()}
            lengths = {**committed, "log.txt": _size(self._trial, "log.txt")}
            for name in APPENDED:
                parts[name] = self._appended(name, lengths.get(name, 0), data)
            for name in (*WHOLE, *saved):
                path = self._trial.folder / name
                content = path.read_bytes() if path.exists() else b""
                part = Part.of(name, 0, content)
                parts[name] = (part,) if content else ()
                data.update({part.key: content} if content else {})
        present = {name: found for name, found in parts.items() if (self._trial.folder / name).exists()}
        digests = {name: extent.sha256 for name, extent in extents.items()}
        stands = replace(record, committed=committed, digests=digests)
        return stands, Manifest(stands, present), data

    def _appended(self, name: str, length: int, data: dict[str, bytes]) -> tuple[Part, ...]:
        """The parts of a row file; its new bytes go into ``data``.

        A new part takes in those before it that are no longer than it: n commits leave about log2(n) parts,
        and each byte is sent about log2(n) times at most.
        """
        parts = list(self._parts.get(name, ()))
        if parts and parts[-1].end > length:  # cut back: not what was sent
            parts.clear()
        start = parts[-1].end if parts else 0
        if start == length:
            return tuple(parts)
        while parts and parts[-1].length <= length - start:
            start = parts.pop().start
        with (self._trial.folder / name).open("rb") as file:
            file.seek(start)
            content = file.read(length - start)
        part = Part.of(name, start, content)
        data[part.key] = content
        return (*parts, part)

    def _other_attempts(self, attempt: str) -> list[str]:
        """The keys of the attempts before this one."""
        others = _attempts(self._remote.objects.keys_in())
        if max(others, default="") > attempt:
            raise LostLeaseError(f"{self._remote.name}: another attempt runs this trial now")
        return [f"{other}/{name}" for other, names in others.items() if other != attempt for name in names]

    def _clear(self, attempt: str, others: Sequence[str]) -> None:
        """Delete what no manifest of the last ones names, and the attempts before this one."""
        self._manifests = self._manifests[-KEPT_MANIFESTS:]
        spare = self._written.difference(*({name, *manifest.keys} for name, manifest in self._manifests))
        keys = sorted(spare)  # manifests before their parts
        self._remote.objects.delete([*(f"{attempt}/{key}" for key in keys), *others])
        self._written -= spare


@contextmanager
def working_copy(
    remote: RemoteTrial, spec: TrialSpec, should_stop: Callable[[], bool]
) -> Iterator[TrialStore]:
    """A folder on this machine for one attempt at a trial that is kept in an object store.

    It holds what the attempts before left. What the body commits there is sent meanwhile, what is left at the
    end: this returns when all of it is there.

    Args:
        remote: where the trial is kept.
        spec: the trial.
        should_stop: once true, a store that is down is waited for no longer than ``STOPPING_SECONDS``.

    Raises:
        StorageError: the store is down, and was for ``PATIENCE_SECONDS``; its last manifest stands.
    """
    with scratch_folder(tempfile.gettempdir()) as folder:
        trial = TrialStore(folder / spec.folder_name)
        patiently(lambda: remote.take_up(trial), should_stop)
        upload = Upload(remote, trial)
        try:
            with beside(partial(_follow, upload), name="upload"):
                yield trial
        except Exception:  # but not a KeyboardInterrupt: that means at once
            _finish(upload, should_stop)
            raise
        _finish(upload, should_stop)


def _finish(upload: Upload, should_stop: Callable[[], bool]) -> None:
    """Send what is left, unless a newer attempt has made it worthless."""
    try:
        patiently(upload.finish, should_stop)
    except LostLeaseError as error:
        logger.warning("%s", error)


def _follow(upload: Upload, over: threading.Event) -> None:
    """Send what is committed, until it is over."""
    pause = LOOK_SECONDS
    while not over.wait(pause):
        try:
            upload.follow()
        except LostLeaseError as error:
            logger.warning("%s", error)
            upload.revoke()
            return
        except (StorageError, OSError) as error:
            if pause == LOOK_SECONDS:
                logger.warning("%s; the trial goes on, this is tried again", error)
            pause = min(2.0 * max(pause, FIRST_PAUSE_SECONDS / 2.0), LONGEST_PAUSE_SECONDS)
        else:
            if pause > LOOK_SECONDS:
                logger.info("the storage takes everything again")
            pause = LOOK_SECONDS


def patiently(act: Callable[[], None], should_stop: Callable[[], bool]) -> None:
    """Do what needs the store, again and again while that is down, with growing pauses.

    Args:
        act: what to do; may be done more than once.
        should_stop: once true, for ``STOPPING_SECONDS`` more.

    Raises:
        StorageError: it was down for ``PATIENCE_SECONDS``.
    """
    began = time.monotonic()
    pause, stopping_since = FIRST_PAUSE_SECONDS, float("inf")
    while True:
        try:
            return act()
        except StorageError as error:
            now = time.monotonic()
            if should_stop():
                stopping_since = min(stopping_since, now)
            left = min(began + PATIENCE_SECONDS, stopping_since + STOPPING_SECONDS) - now
            if left <= 0.0:
                raise
            if pause == FIRST_PAUSE_SECONDS:
                logger.warning("%s; it is tried again for %.0f minutes", error, left / 60.0)
            time.sleep(min(pause, left))
            pause = min(2.0 * pause, LONGEST_PAUSE_SECONDS)


def _attempts(keys: Sequence[str]) -> dict[str, list[str]]:
    """What there is of each attempt: the keys below it. Names of attempts are in the order of their age."""
    found: dict[str, list[str]] = {}
    for key in keys:
        attempt, _, name = key.partition("/")
        if _ATTEMPT.fullmatch(attempt) and name:
            found.setdefault(attempt, []).append(name)
    return found


def _manifests(keys: Sequence[str]) -> list[str]:
    """The keys of all manifests, those of the newest attempt first, and its newest first."""
    found = [
        f"{attempt}/{name}"
        for attempt, names in _attempts(keys).items()
        for name in filter(_MANIFEST.fullmatch, names)
    ]
    return sorted(found, reverse=True)


def _attempt_of(record: TrialRecord) -> str:
    return f"{record.attempt:06d}-{record.token}"


def _commit_of(record: TrialRecord) -> tuple[Any, ...]:
    """What differs between two records only if there was a commit, a beginning or an end between them."""
    return (record.token, record.status, record.error, record.cpu_seconds, *sorted(record.committed.items()))


def _with_life(record: TrialRecord, sign: bytes | None) -> TrialRecord:
    """What a sign of life adds to the record of the last manifest: all but which bytes are there."""
    try:
        alive = TrialRecord.from_json(json.loads(sign or b"null"))
    except (ValueError, KeyError, TypeError):
        return record  # it was cleared away, or cut short: there will be another
    if alive.token == record.token and alive.heartbeat < record.heartbeat:
        return record
    return replace(alive, committed=record.committed, digests=record.digests, checkpoint=record.checkpoint)


def _newest_checkpoint(trial: TrialStore) -> tuple[list[str], dict[str, Extent]]:
    """The newest intact checkpoint, as a path in the trial's folder, if there is one; what rows it has."""
    for path in trial.checkpoints():
        try:
            tree = trial.load_checkpoint(path)
            rows = {name: Extent(length, tree["digests"][name]) for name, length in tree["files"].items()}
            return [f"checkpoints/{path.name}"], rows
        except CheckpointError:
            continue
    return [], {}


def _place(trial: TrialStore, name: str, start: int, data: bytes) -> None:
    """Put bytes into a file: behind those that are there, or in place of the whole file."""
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise StorageError(f"{trial.folder}: what is kept of it names a file outside it: {name!r}")
    path = trial.folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if start == 0:
        write_atomically(path, data)
        return
    with path.open("r+b") as file:
        file.seek(start)
        file.write(data)


def _length(parts: Sequence[Part]) -> int:
    return parts[-1].end if parts else 0


def _size(trial: TrialStore, name: str) -> int:
    path = trial.folder / name
    return path.stat().st_size if path.exists() else 0


def _json(value: Mapping[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
