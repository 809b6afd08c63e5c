"""A sweep in an object store, as seen from a machine that launches or reads it.

    <address>/<sweep>/
        sweep.json, grid.yaml, trials.jsonl     as in a sweep's folder
        trials/                                 see ``remote_trial``
        launch.json                             the launch that runs the sweep, see ``launch_lease``
        stop.request                            exists while that launch is asked to stop
        stop-<run>                              stop signal for the workers of one run

The sweep's folder on this machine is a copy, which plan, status, figures and MLflow read like any sweep's
folder. It may be deleted at any time, but MLflow's default database, figures, evaluations and videos are only
there.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from contextvars import Context, copy_context
from functools import partial
from itertools import repeat
from pathlib import Path

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import DamagedError, RecrlError, StorageError
from recrl.orchestrator.files.atomic_files import read_sealed, write_atomically, write_sealed
from recrl.orchestrator.files.locks import locked
from recrl.orchestrator.files.stop_file import StopSignal
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.remote.commit_upload import ALIVE_SECONDS, working_copy
from recrl.orchestrator.remote.launch_lease import LaunchLease
from recrl.orchestrator.remote.object_store import ObjectStore
from recrl.orchestrator.remote.remote_trial import ALIVE, RemoteTrial
from recrl.orchestrator.remote.retries import repeat_until, retry_while_down
from recrl.orchestrator.remote.stop_object import StopObject
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace

PULL_SECONDS = 10.0  # between two reads of the running trials
PULLS_AT_ONCE = 8

STORAGE_FORMAT = 2

logger = logging.getLogger("recrl.sweep")


class RemoteSweep(SweepPlace):
    """One sweep in an object store.

    Attributes:
        uri: the address of all sweeps there.
        store: the sweep's folder on this machine, a copy.
        objects: of the sweep's folder in the object store.
        lease: of the launch that runs the sweep.
    """

    shortest_silence_seconds = 2.0 * (ALIVE_SECONDS + PULL_SECONDS)

    def __init__(self, uri: str, store: SweepStore) -> None:
        """Check the address, without access to the store.

        Raises:
            RecrlError: the address is invalid, or needs a package that is not installed.
        """
        super().__init__(store)
        root = ObjectStore(uri)
        self.uri = root.uri
        self.objects = root.below(store.name)
        self.lease = LaunchLease(self.objects)
        self._pulled: dict[str, list[str]] = {}
        self._in_touch_at = time.monotonic()

    @property
    def address(self) -> str:
        """The address of this sweep."""
        return self.objects.uri

    def prepare(self) -> None:
        """Test the object store, and make the folder the copy of this sweep.

        Raises:
            RecrlError: the store cannot be used, the folder is not its copy, or has trials that are not in
                the store.
        """
        self.objects.probe()
        self.mark()
        self._is_in_store()

    def _is_in_store(self) -> bool:
        """Return whether the sweep has been launched into the store.

        Raises:
            StorageError: the store cannot be read, or has nothing of it although the folder is a copy of its
                trials.
        """
        if self.objects.read("sweep.json") is not None:
            return True
        if any(trial.is_local_copy for trial in self.store.trials()) and not self.objects.keys_in("trials"):
            raise StorageError(
                f"{self.address}: there is no such sweep, although {self.store.folder} is a copy of its "
                "trials; restore the store, or give the sweep another name or another --root"
            )
        return False

    def require_reruns(self) -> None:
        """Raise an error: trials in an object store cannot be run again.

        Raises:
            RecrlError: always.
        """
        raise RecrlError(
            f"{self.uri}: trials of a sweep in an object store are not run again: give the sweep "
            "another name; if only its folder here is damaged, delete that, and it is fetched "
            "again"
        )

    def held(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Hold the sweep as the only launch on all machines; see ``LaunchLease.held``."""
        return self.lease.held(stop)

    def request_stop(self) -> Callable[[], bool]:
        """Ask the launch that runs the sweep, on any machine, to save its trials and end."""
        if self.store.is_locked() or not self.lease.is_held():
            return super().request_stop()
        self.lease.request_stop()
        return self.lease.is_held

    def mark(self) -> None:
        """Make the folder the copy of this sweep.

        Raises:
            RecrlError: it is a sweep itself, the copy of another, or the object store.
        """
        store, known = self.store, remembered_uri(self.store)
        if self.objects.folder is not None and self.objects.folder.resolve() == store.folder.resolve():
            raise RecrlError(
                f"{store.folder}: the object store and its local copy cannot be the same folder; give "
                "another --root"
            )
        if known is None and (store.info_path.exists() or store.trials_folder.exists()):
            raise RecrlError(
                f"{store.folder}: this sweep is kept in that folder, not at {self.uri}; give another --root, "
                "or the sweep another name"
            )
        if known is not None and known != self.uri:
            raise RecrlError(
                f"{store.folder}: this sweep is kept at {known}, not at {self.uri}; give another "
                "--root, or delete the folder, which is only a local copy"
            )
        store.folder.mkdir(parents=True, exist_ok=True)
        if known is None:
            write_sealed(store.storage_path, {"name": store.name, "uri": self.uri}, version=STORAGE_FORMAT)

    def trial(self, name: str) -> RemoteTrial:
        """Return the trial of a folder's name; it need not exist yet."""
        return RemoteTrial(self.objects.below(f"trials/{name}"), name)

    def working_copy(
        self, spec: TrialSpec, should_stop: Callable[[], bool]
    ) -> AbstractContextManager[TrialStore]:
        """See ``SweepPlace`` and ``commit_upload.working_copy``."""
        return working_copy(self.trial(spec.folder_name), spec, should_stop)

    def new_stop_signal(self) -> AbstractContextManager[StopSignal]:
        """Return the stop signal of a new run; see ``StopObject.open``."""
        return StopObject.open(self.objects)

    def stop_signal_at(self, place: str) -> StopSignal:
        """See ``SweepPlace``."""
        return StopObject(self.objects, place)

    def refresh(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date, or log that it is not.

        Raises:
            StorageError: the store cannot be read, and the folder is empty.
        """
        if self.store.is_locked():
            return  # the launch on this machine does it regularly
        try:
            if self._is_in_store():
                self.mark()
                self.pull(checkpoints=checkpoints)
        except StorageError as error:
            if not self.store.info_path.exists():
                raise
            logger.warning("%s; the following is from the last update of the copy", error)

    def pull(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date.

        Args:
            checkpoints: whether to include those of running trials; those of finished ones always are.

        Raises:
            StorageError: the store cannot be read.
        """
        with self._alone():
            for path in _sweep_files(self.store):
                data = self.objects.read(path.name)
                if data is not None and not (path.exists() and path.read_bytes() == data):
                    write_atomically(path, data)
        self._pull_trials(checkpoints=checkpoints)

    def _pull_trials(self, *, checkpoints: bool = False) -> None:
        with self._alone():
            keys: dict[str, list[str]] = {}
            for key in self.objects.keys_in("trials"):
                name, _, rest = key.partition("/")
                if rest and name not in (".", ".."):
                    keys.setdefault(name, []).append(rest)

            def pull_trial(name: str) -> None:
                self.trial(name).download(self.store.trial_named(name), keys[name], checkpoints=checkpoints)

            before = {} if checkpoints else self._pulled
            news = [name for name in keys if _is_new(keys[name], before.get(name))]
            contexts = [copy_context() for _ in news]  # a thread refuses import paths if this one does
            with ThreadPoolExecutor(PULLS_AT_ONCE) as pool:
                list(pool.map(Context.run, contexts, repeat(pull_trial), news))
            self._pulled = keys
        self._in_touch_at = time.monotonic()

    def pull_trial(self, spec: TrialSpec) -> None:
        """Bring one trial in the folder up to date.

        Raises:
            StorageError: the store cannot be read.
        """
        with self._alone():
            self.trial(spec.folder_name).download(self.store.trial(spec), checkpoints=False)

    def is_out_of_touch(self, silence_seconds: float) -> bool:
        """Return whether the folder is too old to conclude from a silence of this many seconds.

        The bound is a third of the silence: after an outage of that length, nodes may pause as long before
        they write again. Reading a thousand running trials takes longer than the pause between two reads.
        """
        return time.monotonic() - self._in_touch_at > max(3.0 * PULL_SECONDS, silence_seconds / 3.0)

    @contextmanager
    def kept_up_to_date(self, stop: threading.Event, *, every: float = PULL_SECONDS) -> Iterator[None]:
        """Pull the trials regularly in a background thread during the body, and once more after it.

        Args:
            stop: once set, the wait for a store that is down is short.
            every: seconds between two pulls; more while the store is down.

        Raises:
            StorageError: the store cannot be read at the end.
        """
        follow = partial(repeat_until, self._pull_trials, every=every, hint="the trials continue")
        with background_thread(follow, name="local copy"):
            yield
        retry_while_down(self._pull_trials, stop.is_set)

    def publish(self) -> None:
        """Send the sweep's own files.

        Raises:
            StorageError: the store cannot be written.
        """
        for path in _sweep_files(self.store):
            self.objects.write(path.name, path.read_bytes())

    def send_dead_trials(self, specs: Sequence[TrialSpec]) -> None:
        """Send the status of trials whose processes died, which only this machine knows.

        Everything else is sent as the store has it, because the copy here may be damaged. Nothing is sent
        once another launch has taken over the sweep: its attempts may be running.

        Args:
            specs: the trials; none of them runs, and the folder has their status from
                ``TrialStore.set_status``.

        Raises:
            StorageError: the store cannot be read or written.
        """
        if not self.lease.belongs_to_another():
            for spec in specs:
                self._send_dead_trial(spec)

    def _send_dead_trial(self, spec: TrialSpec) -> None:
        trial = self.store.trial(spec)
        record = trial.record()
        if record.token or record.status not in (TrialStatus.FAILED, TrialStatus.WAITING):
            return
        if record.status is TrialStatus.WAITING and not record.attempt:
            return  # never begun
        remote = self.trial(spec.folder_name)
        remote.download(trial, checkpoints=False)
        if trial.record() != record:
            return  # its own process has recorded its end
        try:
            with working_copy(remote, spec, lambda: True) as original:
                original.begin(spec).close(record.status, error=record.error)
        except DamagedError as error:
            logger.warning("%s", error)
            return
        remote.download(trial, checkpoints=False)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Hold the lock of the copy, as the only process and thread that writes it."""
        self.store.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.store.folder / ".pull"):
            yield


def sweep_place(store: SweepStore, given: str | None = None) -> SweepPlace:
    """Return a sweep's place: the given address, the address stored in its folder, or the folder.

    Args:
        store: the sweep's folder on this machine.
        given: the address of an object store, or None.

    Raises:
        RecrlError: the address is invalid, needs a package that is not installed, or cannot be read.
    """
    if not given and not store.storage_path.exists():
        return SweepPlace(store)
    uri = given or remembered_uri(store)
    return RemoteSweep(uri, store) if uri else SweepPlace(store)


def remembered_uri(store: SweepStore) -> str | None:
    """Return the address of which a folder is a copy; None if it is no copy.

    Raises:
        StorageError: the file with the address is damaged.
    """
    try:
        kept = read_sealed(store.storage_path, version=STORAGE_FORMAT)
        if kept["name"] != store.name:
            own = f"that of the sweep {kept['name']}, whose name the folder must have"
            raise DamagedError(f"{store.storage_path.name} is {own}")
    except FileNotFoundError:
        return None
    except StorageError as error:
        raise type(error)(
            f"{store.name}: {error}, so that the sweep's address is unknown; delete it and give "
            "--storage URI again"
        ) from error
    return str(kept["uri"])


def sweeps_at(uri: str) -> list[str]:
    """Return the names of the sweeps at an address.

    Raises:
        RecrlError: the address is invalid, or the store cannot be read.
    """
    root = ObjectStore(uri)
    return [name for name in root.names("directory") if root.read(f"{name}/sweep.json") is not None]


def _is_new(keys: list[str], before: list[str] | None) -> bool:
    """Return whether a trial with these keys may have changed since an earlier list of keys.

    A running attempt changes its sign of life in place; every other change adds a key.
    """
    return keys != before or any(key.endswith(f"/{ALIVE}") for key in keys)


def _sweep_files(store: SweepStore) -> tuple[Path, ...]:
    return (store.info_path, store.grid_path, store.specs_path)
