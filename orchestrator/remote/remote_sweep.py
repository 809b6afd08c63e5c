"""A sweep that is kept in an object store, as seen from the machine that launches or looks at it.

    <address>/<sweep>/
        sweep.json, grid.yaml, trials.jsonl     as in a sweep's folder
        trials/                                 see ``remote_trial``
        launch.json                             who runs the sweep, and when that one last said so
        stop.request                            there while somebody asks that one to stop
        stop-<run>                              tells the workers of one run to go on, or to stop

The sweep's folder on this machine is a mirror of it: plan, status, figures and MLflow read the mirror as
they read any sweep's folder. It may be deleted at any time; MLflow's default database, figures, evaluations
and videos are in it alone.

Two launches at once: the first creates ``launch.json``, the second is refused, where the store creates an
object only once (S3, Google, Azure). That file of a launch that died is free after ``SILENT_SECONDS``, by
the machines' clocks. Should two launches run all the same, one sees the other's name there within
``BEAT_SECONDS`` and stops; until then they may do the same work twice, but never damage it: each attempt
writes below its own name.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from recrl.orchestrator.background import beside
from recrl.orchestrator.errors import DamagedError, LostLeaseError, RecrlError, StorageError, SweepBusyError
from recrl.orchestrator.files.locks import open_lock
from recrl.orchestrator.files.small_files import read_sealed, write_atomically, write_sealed
from recrl.orchestrator.files.store import SweepStore, TrialStore
from recrl.orchestrator.remote.object_store import ObjectStore
from recrl.orchestrator.remote.remote_trial import ALIVE, RemoteTrial, Upload, patiently, working_copy
from recrl.orchestrator.spec import TrialSpec, TrialState

PULL_SECONDS = 10.0  # between two looks at the trials that run
LONGEST_PAUSE_SECONDS = 60.0  # between two looks while the store is down
LOOK_SECONDS = 5.0  # between two looks whether somebody asks to stop
BEAT_SECONDS = 15.0  # between two signs of life of a launch
EMPTY_SECONDS = 1.0  # after which what is being written is there
SILENT_SECONDS = 90.0  # without one, after which its sweep is free
STOP_QUESTION_SECONDS = 5.0  # between two questions of a worker whether to stop
PULLS_AT_ONCE = 8

LAUNCH = "launch.json"
STORAGE_FORMAT = 2
STOP_REQUEST = "stop.request"

logger = logging.getLogger("recrl.sweep")


class RemoteSweep:
    """One sweep in an object store.

    Attributes:
        uri: the address of all sweeps there.
        name: the sweep's.
        objects: what lies below the sweep's folder.
    """

    def __init__(self, uri: str, name: str) -> None:
        """Look at nothing yet.

        Raises:
            RecrlError: the address is none, or needs a package that is not installed.
        """
        root = ObjectStore(uri)
        self.uri = root.uri
        self.name = name
        self.objects = root.below(name)
        self._mirrored: dict[Path, dict[str, list[str]]] = {}
        self._in_touch_at = time.monotonic()
        self._token = ""  # of the launch that this is, if it is one

    @classmethod
    def of(cls, store: SweepStore) -> RemoteSweep | None:
        """What a folder is the mirror of, if it is one.

        Raises:
            RecrlError: as the constructor.
        """
        try:
            kept = read_sealed(store.storage_path, version=STORAGE_FORMAT)
            if kept["name"] != store.name:
                raise DamagedError(f"{store.storage_path.name} is that of another sweep, {kept['name']}")
        except FileNotFoundError:
            return None
        except StorageError as error:
            raise type(error)(
                f"{store.name}: {error}, so that nobody knows where the sweep is kept; delete it and give "
                "--storage URI again"
            ) from error
        return cls(kept["uri"], store.name)

    def mark(self, store: SweepStore) -> None:
        """Make a folder the mirror of this sweep.

        Raises:
            RecrlError: it is a sweep of its own, or the mirror of another.
        """
        present = RemoteSweep.of(store)
        if present is None and (store.info_path.exists() or store.trials_folder.exists()):
            raise RecrlError(
                f"{store.folder}: this sweep is kept in that folder, not at {self.uri}; give another --root, "
                "or the sweep another name"
            )
        if present is not None and present.uri != self.uri:
            raise RecrlError(
                f"{store.folder}: this sweep is kept at {present.uri}, not at {self.uri}; give another "
                "--root, or delete the folder, which is only a mirror"
            )
        store.folder.mkdir(parents=True, exist_ok=True)
        if present is None:
            write_sealed(store.storage_path, {"name": store.name, "uri": self.uri}, version=STORAGE_FORMAT)

    def is_there(self) -> bool:
        """Whether it was launched.

        Raises:
            StorageError: the store cannot be read.
        """
        return self.objects.read("sweep.json") is not None

    def trial(self, name: str) -> RemoteTrial:
        """The trial of a folder's name; it need not be there yet."""
        return RemoteTrial(self.objects.below(f"trials/{name}"), name)

    def working_copy(
        self, spec: TrialSpec, should_stop: Callable[[], bool]
    ) -> AbstractContextManager[TrialStore]:
        """A folder on this machine for one attempt at a trial; see ``remote_trial.working_copy``."""
        return working_copy(self.trial(spec.folder_name), spec, should_stop)

    def pull(self, store: SweepStore, *, checkpoints: bool = False) -> None:
        """Bring the mirror up to what is there.

        Args:
            store: the mirror.
            checkpoints: whether to bring those of trials that still run; those of finished ones come always.

        Raises:
            StorageError: the store cannot be read.
        """
        with _alone(store):
            for path in _sweep_files(store):
                data = self.objects.read(path.name)
                if data is not None and not (path.exists() and path.read_bytes() == data):
                    write_atomically(path, data)
        self._pull_trials(store, checkpoints=checkpoints)

    def _pull_trials(self, store: SweepStore, *, checkpoints: bool = False) -> None:
        with _alone(store):
            keys: dict[str, list[str]] = {}
            for key in self.objects.keys_in("trials"):
                name, _, rest = key.partition("/")
                if rest and name not in (".", ".."):
                    keys.setdefault(name, []).append(rest)

            def pull_trial(name: str) -> None:
                trial = store.trial_named(name)
                self.trial(name).mirror(trial, keys[name], checkpoints=checkpoints)

            before = {} if checkpoints else self._mirrored.get(store.folder, {})
            news = [name for name in keys if _is_new(keys[name], before.get(name))]
            with ThreadPoolExecutor(PULLS_AT_ONCE) as pool:
                list(pool.map(pull_trial, news))
            self._mirrored[store.folder] = keys
        self._in_touch_at = time.monotonic()

    def pull_trial(self, store: SweepStore, spec: TrialSpec) -> None:
        """Bring one trial's mirror up to what is there.

        Raises:
            StorageError: the store cannot be read.
        """
        with _alone(store):
            self.trial(spec.folder_name).mirror(store.trial(spec), checkpoints=False)

    def is_out_of_touch(self, silence_seconds: float) -> bool:
        """Whether the mirror is so old that a silence of so many seconds in it says nothing.

        A third of them: after that long an outage, nodes may pause as long before they speak again. One look
        at a thousand running trials takes longer than the pause between two.
        """
        return time.monotonic() - self._in_touch_at > max(3.0 * PULL_SECONDS, silence_seconds / 3.0)

    @contextmanager
    def mirrored(
        self, store: SweepStore, stop: threading.Event, *, every: float = PULL_SECONDS
    ) -> Iterator[None]:
        """Pull the trials again and again, from a thread beside the body, and once more after it.

        Args:
            store: the mirror.
            stop: once set, a store that is down is not waited for long.
            every: seconds between two times; more while the store is down.

        Raises:
            StorageError: the store cannot be read at the end.
        """

        def follow(over: threading.Event) -> None:
            pause = every
            while not over.wait(pause):
                try:
                    self._pull_trials(store)
                except (StorageError, OSError) as error:
                    if pause == every:
                        logger.warning("%s; the trials go on", error)
                    pause = min(2.0 * pause, LONGEST_PAUSE_SECONDS)
                else:
                    pause = every

        with beside(follow, name="mirror"):
            yield
        patiently(lambda: self._pull_trials(store), stop.is_set)

    def publish(self, store: SweepStore) -> None:
        """Say there what the sweep is, as the folder does.

        Raises:
            StorageError: the store cannot be written.
        """
        for path in _sweep_files(store):
            self.objects.write(path.name, path.read_bytes())

    def settle(self, specs: Sequence[TrialSpec], store: SweepStore) -> None:
        """Say there what only this machine knows of trials: that their process died without a word.

        Nothing is said once another launch has taken the sweep over: its attempts may be at work on them.

        Args:
            specs: the trials.
            store: the mirror, where that was said by ``TrialStore.set_status``; nobody works on them now.

        Raises:
            StorageError: the store cannot be read or written.
        """
        holder = self._holder()
        if _is_alive(holder) and holder.get("token") != self._token:
            return
        for spec in specs:
            trial = store.trial(spec)
            record = trial.record()
            if record.token or record.status not in (TrialState.FAILED, TrialState.WAITING):
                continue
            if record.status is TrialState.WAITING and not record.attempt:
                continue  # never begun
            remote = self.trial(spec.folder_name)
            remote.mirror(trial, checkpoints=True)
            if trial.record() != record:
                continue  # it said itself how it ended
            upload = Upload(remote, trial)
            writer = trial.begin(spec)
            writer.close(record.status, error=record.error)
            try:
                upload.finish()
            except LostLeaseError as error:
                logger.warning("%s", error)

    @contextmanager
    def held(self, stop: threading.Event) -> Iterator[None]:
        """Be the one launch that runs the sweep; set ``stop`` when somebody asks for it, or has taken over.

        Raises:
            SweepBusyError: another one is.
            StorageError: the store cannot be read or written.
        """
        own = {
            "token": secrets.token_hex(8),
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "boot": _boot(),
        }
        self._take(own)
        self._token = str(own["token"])
        try:
            self.objects.delete([STOP_REQUEST])
            with beside(partial(self._hold, own, stop), name="launch"):
                yield
        finally:
            try:
                if self._holder().get("token") == own["token"]:
                    self.objects.delete([STOP_REQUEST, LAUNCH])
            except StorageError as error:
                logger.warning("%s; the sweep is free again in %.0f seconds", error, SILENT_SECONDS)

    def request_stop(self) -> None:
        """Ask the launch that runs the sweep, on whatever machine, to save its trials and end.

        Raises:
            StorageError: the store cannot be written.
        """
        self.objects.write(STOP_REQUEST, b"stop\n")

    def is_held(self) -> bool:
        """Whether a launch runs the sweep, on whatever machine.

        Raises:
            StorageError: the store cannot be read.
        """
        return _is_alive(self._holder())

    def _take(self, own: dict[str, Any]) -> None:
        """Create ``launch.json``, in place of that of a dead launch if need be."""
        if self._is_created(own):
            return
        holder = self._holder()
        if not holder:  # somebody is just about to write what it holds, or nobody ever will
            time.sleep(EMPTY_SECONDS)
            holder = self._holder()
        if holder.get("token") == own["token"]:
            return  # it was written, though the answer was lost
        if _is_alive(holder):
            silent = max(0.0, time.time() - holder["at"])
            raise SweepBusyError(
                f"{self.objects.uri}: this sweep is already being run by process {holder['pid']} on "
                f"{holder['host']}, which said so {silent:.0f} seconds ago; wait for it or stop it (if it "
                f"was killed, the sweep is free after {SILENT_SECONDS:.0f} seconds of silence)"
            )
        self.objects.delete([LAUNCH])
        if not self._is_created(own):
            raise SweepBusyError(f"{self.objects.uri}: another process has begun to run this sweep just now")

    def _is_created(self, own: dict[str, Any]) -> bool:
        """Create ``launch.json`` and look whether it is ours: not every store can create exclusively."""
        created = self.objects.create(LAUNCH, _beat(own))
        return created and self._holder().get("token") == own["token"]

    def _hold(self, own: dict[str, Any], stop: threading.Event, over: threading.Event) -> None:
        """Go on saying that this launch lives, and listen."""
        spoke_at = time.monotonic()
        while not over.wait(LOOK_SECONDS):
            try:
                if self.objects.read(STOP_REQUEST) is not None:
                    stop.set()
                if time.monotonic() >= spoke_at + BEAT_SECONDS:
                    holder = self._holder()
                    if holder and holder.get("token") != own["token"]:
                        logger.warning("%s: another launch has taken the sweep over", self.objects.uri)
                        stop.set()
                        return
                    self.objects.write(LAUNCH, _beat(own))
                    spoke_at = time.monotonic()
            except StorageError as error:  # whoever pulls says it
                logger.debug("%s", error)

    def _holder(self) -> dict[str, Any]:
        """Who runs the sweep, as last said; empty if nobody does."""
        try:
            value = json.loads(self.objects.read(LAUNCH) or b"{}")
        except ValueError:
            return {}
        return value if isinstance(value, dict) else {}


class StopObject:
    """How one run of a sweep tells its workers, on any node, to save and stop: see ``StopFile``.

    Attributes:
        key: of the object, below the sweep.
    """

    def __init__(self, objects: ObjectStore, key: str) -> None:
        self._objects = objects
        self.key = key
        self._answer = False
        self._asked_at = float("-inf")

    @property
    def place(self) -> str:
        """By which workers find it, beside the sweep's address."""
        return self.key

    @property
    def uri(self) -> str:
        """The sweep's address."""
        return self._objects.uri

    @classmethod
    @contextmanager
    def open(cls, objects: ObjectStore) -> Iterator[StopObject]:
        """That of a new run; whatever may be left of earlier runs is told to stop.

        Raises:
            StorageError: the store cannot be written.
        """
        objects.delete(key for key in objects.names("file") if key.startswith("stop-"))
        sign = cls(objects, f"stop-{secrets.token_hex(4)}")
        objects.write(sign.key, b"go on\n")
        try:
            yield sign
        finally:
            try:
                objects.delete([sign.key])
            except StorageError as error:
                logger.warning("%s", error)

    def set(self) -> None:
        """Tell the workers to stop; tried again by whoever calls again."""
        if self._answer:
            return
        try:
            self._objects.write(self.key, b"stop\n")
            self._answer = True
        except StorageError as error:
            logger.debug("%s", error)

    def is_set(self) -> bool:
        """Whether to stop; asks every ``STOP_QUESTION_SECONDS`` at most. No answer is none."""
        if not self._answer and time.monotonic() >= self._asked_at + STOP_QUESTION_SECONDS:
            self._asked_at = time.monotonic()
            try:
                self._answer = self._objects.read(self.key) != b"go on\n"
            except StorageError as error:
                logger.debug("%s", error)
        return self._answer


def sweeps_at(uri: str) -> list[str]:
    """The names of the sweeps that are kept at an address.

    Raises:
        RecrlError: the address is none, or the store cannot be read.
    """
    root = ObjectStore(uri)
    return [name for name in root.names("directory") if root.read(f"{name}/sweep.json") is not None]


def _is_new(keys: list[str], before: list[str] | None) -> bool:
    """Whether a trial of these keys may have changed since it had those before.

    An attempt at work changes its sign of life in place; all else has a key of its own.
    """
    return keys != before or any(key.endswith(f"/{ALIVE}") for key in keys)


def _sweep_files(store: SweepStore) -> tuple[Path, ...]:
    return (store.info_path, store.grid_path, store.specs_path)


def _beat(own: dict[str, Any]) -> bytes:
    return json.dumps({**own, "at": time.time()}).encode()


def _is_alive(holder: dict[str, Any]) -> bool:
    """Whether a launch that says so runs: it spoke lately, and its process is not known to be dead."""
    try:
        if time.time() - float(holder["at"]) > SILENT_SECONDS:
            return False
        if not _boot() or holder["boot"] != _boot():
            return True
        os.kill(int(holder["pid"]), 0)  # signal 0 only asks
    except (KeyError, TypeError, ValueError, ProcessLookupError):
        return False
    except PermissionError:
        pass  # somebody else's process, so it is there
    return True


def _boot() -> str:
    """Where and since when process numbers mean what they mean here; empty where nobody can say."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


@contextmanager
def _alone(store: SweepStore) -> Iterator[None]:
    """Be the only process and thread that writes the mirror."""
    store.folder.mkdir(parents=True, exist_ok=True)
    with open_lock(store.folder / ".pull") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
