"""Trials on Ray: Tune hands them to worker processes on one machine or many, and the files keep the truth.

Tune is a scheduler that may die. Every run is a fresh Tune experiment over the specs it is given (never
``Tuner.restore``); a Tune trial is one recrl trial, from wherever its own newest checkpoint stands; and Tune
learns nothing of it but that it ended. A worker process runs one trial after the other, because a trial's
result depends on its spec alone, and importing torch anew costs as much as a small trial.

What fails, and what happens: a worker or its node dies, and Tune starts the trial again, up to
``max_failures`` times; a trial's own code raises, and it is FAILED in its files and not tried again; the
driver dies, and its workers with it; a trial hangs, its heartbeat falls silent, and its process is ended,
which is the first case again.

A signal to the launch and to its whole process group (Ctrl-C, ``timeout``) reaches the driver alone: Ray's
processes have sessions of their own, and serve until the trials are saved.

Assumes that every node sees the results folder under the same path, or reaches the object store that the
trials are kept in, and has the same recrl: where the cluster is somebody else's, every node is asked for both
before the first trial. Leaves out growing with an elastic cluster beyond ``max_concurrent``.
"""

from __future__ import annotations

import inspect
import json
import logging
import os
import secrets
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import ray
from ray import cloudpickle, tune
from ray.exceptions import (
    ActorDiedError,
    ActorUnavailableError,
    NodeDiedError,
    OutOfMemoryError,
    RayTaskError,
    TaskCancelledError,
    WorkerCrashedError,
)
from ray.tune.search import BasicVariantGenerator

from recrl.orchestrator.errors import ClusterError, StorageError, TeacherUnavailableError
from recrl.orchestrator.files.own_package import copy_package
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.store import SweepStore, TrialRecord, TrialStore
from recrl.orchestrator.ray.nodes import check_nodes, trials_that_fit
from recrl.orchestrator.ray.services import (
    RAY_FOLDER,
    TOKEN,
    TOKEN_VARIABLE,
    LostServices,
    end_processes,
    end_processes_of_the_dead,
)
from recrl.orchestrator.ray.teacher_service import RayTeacher, find_teacher_service, start_teacher_service
from recrl.orchestrator.redaction import shown
from recrl.orchestrator.remote.remote_sweep import RemoteSweep, StopObject
from recrl.orchestrator.spec import TrialSpec, TrialState
from recrl.orchestrator.status import SILENCE_SECONDS

if TYPE_CHECKING:
    from recrl.orchestrator.grid.file_models import Resources

STOP_QUESTION_SECONDS = 0.5
HEARTBEAT_SECONDS = 2.0  # between two looks at the heartbeats, at least
FIRST_WORD_SILENCES = 5  # as long as so many a process may be silent before it first speaks of its trial
LONGEST_PAUSE_SECONDS = 0.5  # in which nobody asks Ray whether a trial has ended
PAUSE_SHARE = 0.01  # of the time since a trial last began or ended
CONNECT_SECONDS = 5.0
CONNECT_TRIES = 3
OBJECT_STORE_BYTES = 80 * 2**20  # Ray wants 75 MiB at least; nothing of ours is that large
LONGEST_SOCKET_FOLDER = 40  # characters: a socket's path may have 107, of which Ray takes up to 67

QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_AIR_NEW_OUTPUT": "0",  # the new output speaks at verbosity 0, the old one does not
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # the stop event is the one way to stop
    "TUNE_GLOBAL_CHECKPOINT_S": "1e9",  # nobody restores Tune's own state
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
    "TUNE_WARN_THRESHOLD_S": "60",
}
WORKER = {
    "OMP_NUM_THREADS": "1",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
}

# Ray's processes look after themselves up to ten times a second. A cluster of our own has one machine, no
# objects to speak of, and nobody who reads its metrics; none of these settings tells that a process has died.
# They go into Ray's environment, where a version that does not know one leaves it alone.
SELDOM: Mapping[str, int] = {
    "enable_metrics_collection": 0,
    "gcs_pull_resource_loads_period_milliseconds": 10_000,  # for an autoscaler
    "kill_idle_workers_interval_ms": 1_000,
    "local_fs_monitor_interval_ms": 10_000,  # before objects are spilled to disk
    "memory_monitor_refresh_ms": 2_000,
    "object_manager_timer_freq_ms": 1_000,
    "prestart_worker_first_driver": 0,  # a worker without work wakes a hundred times a second
    "raylet_check_gc_period_milliseconds": 10_000,
}
LOOPBACK = "127.0.0.1"
# Processes that ``ray start`` can leave out and ``ray.init`` cannot: one copies the workers' output to the
# driver, which does not want it (trials have logs), the other asks for machines where there are none.
LEFT_OUT: Mapping[str, Any] = {"include_log_monitor": False, "no_monitor": True}

logger = logging.getLogger("recrl.sweep")


@dataclass(frozen=True)
class RayExecutor:
    """Runs trials side by side on Ray; an ``Executor``.

    Attributes:
        num_cpus: cores of the cluster that is started on this machine; all of them if None.
        address: an existing cluster (``auto``, ``host:port``) to use instead.
        ship_package: whether to send recrl itself to that cluster's nodes.
        cpus_per_trial: cores a trial takes, above 0; may be a fraction.
        gpus_per_trial: GPUs a trial takes, at least 0; may be a fraction.
        custom_per_trial: what else a trial takes, by the names that the nodes were given, above 0.
        max_concurrent: trials at once, at least 1; if None, as many as fit when the run begins.
        teacher: ``service`` for one actor that teaches the whole sweep, ``inline`` for a teacher in every
            worker. The results are the same.
        max_failures: how often a trial whose process died is started again, at least 0.
        commit_seconds: wall seconds between a trial's checkpoints, above 0.
        silence_seconds: wall seconds without a heartbeat after which a trial hangs, above 0.
        storage: where the trials are kept; None for the sweep's folder, which every node then sees.
    """

    num_cpus: int | None = None
    address: str | None = None
    ship_package: bool = False
    cpus_per_trial: float = 1.0
    gpus_per_trial: float = 0.0
    custom_per_trial: Mapping[str, float] = field(default_factory=dict)
    max_concurrent: int | None = None
    teacher: Literal["service", "inline"] = "service"
    max_failures: int = 3
    commit_seconds: float = 20.0
    silence_seconds: float = SILENCE_SECONDS
    storage: RemoteSweep | None = None

    def run(self, specs: Sequence[TrialSpec], store: SweepStore, stop: threading.Event) -> None:
        """See ``Executor.run``. Uses the Ray cluster that this process is connected to, if it is.

        Raises:
            ClusterError: Ray cannot be started or reached, lacks what one trial asks for, or has nodes that
                differ from this one.
        """
        if not specs or stop.is_set():
            return
        lost = LostServices()
        with _environment(QUIET | WORKER), lost.watched(self._cluster()), self._stop_sign(store) as stop_sign:
            if self.address and isinstance(stop_sign, StopObject):
                check_nodes(stop_sign.key, stop_sign.uri)
            elif self.address:
                check_nodes(stop_sign.place)
            self._run_on_cluster(specs, store, stop, stop_sign, lost)

    def _stop_sign(self, store: SweepStore) -> AbstractContextManager[StopFile | StopObject]:
        return StopObject.open(self.storage.objects) if self.storage else StopFile.open(store.folder)

    def _cluster(self) -> AbstractContextManager[None]:
        if ray.is_initialized():
            return nullcontext()
        if self.address:
            return existing_cluster(self.address, ship_package=self.ship_package)
        return local_cluster(self.num_cpus)

    def _run_on_cluster(
        self,
        specs: Sequence[TrialSpec],
        store: SweepStore,
        stop: threading.Event,
        stop_sign: StopFile | StopObject,
        lost: LostServices,
    ) -> None:
        queue = BasicVariantGenerator(max_concurrent=min(len(specs), self._slots()))
        silence = _Silence(store, self.silence_seconds, self.storage)
        watch = _Watch(stop, stop_sign, queue, store, silence, lost=lost, storage=self.storage)
        service_name = f"teacher-{secrets.token_hex(8)}" if self.teacher == "service" else ""
        service = start_teacher_service(service_name) if service_name else None
        with scratch_folder(tempfile.gettempdir()) as scratch:
            tuner = tune.Tuner(
                tune.with_resources(TuneTrial, dict(self._wanted)),
                param_space={
                    "spec": tune.grid_search([json.dumps(spec.to_json()) for spec in specs]),
                    "sweep": str(store.folder),
                    "storage": self.storage.uri if self.storage else "",
                    "stop_sign": stop_sign.place,
                    "teacher_service": service_name,
                    "commit_seconds": self.commit_seconds,
                },
                tune_config=tune.TuneConfig(
                    search_alg=queue,
                    reuse_actors=True,
                    trial_name_creator=_tune_trial_id,
                    trial_dirname_creator=_tune_trial_id,
                ),
                run_config=tune.RunConfig(
                    storage_path=str(scratch),
                    name="sweep",
                    verbose=0,
                    callbacks=[watch],
                    stop=_StopWhenIdle(watch),
                    failure_config=tune.FailureConfig(max_failures=self.max_failures),
                    checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
                ),
            )
            with _own_signal_handlers():
                tuner.fit()
        del service  # Ray ends an actor that nobody holds

    @property
    def _wanted(self) -> Mapping[str, float]:
        """What one trial takes, by Ray's names."""
        return {"CPU": self.cpus_per_trial, "GPU": self.gpus_per_trial, **self.custom_per_trial}

    def _slots(self) -> int:
        """How many trials may run at once."""
        slots = trials_that_fit(self._wanted)
        if self.address:  # an existing cluster may grow
            if not slots:
                logger.warning("no node has room for a trial (%s) yet; they wait", _amounts(self._wanted))
            return self.max_concurrent or max(1, slots)
        if slots < 1:
            resources: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
            there = {name: resources.get(name, 0.0) for name in self._wanted}
            raise ClusterError(
                f"a trial asks for {_amounts(self._wanted)}, this cluster has {_amounts(there)}; "
                "ask for less or add machines"
            )
        return min(slots, self.max_concurrent or slots)


def room_on_cluster(address: str, resources: Resources) -> int:
    """How many trials an existing cluster holds at once, at least 0.

    Args:
        address: as ``existing_cluster`` has it.
        resources: what a trial takes.

    Raises:
        ClusterError: it cannot be reached.
    """
    with _environment(QUIET | WORKER), existing_cluster(address):
        return trials_that_fit(
            {
                "CPU": resources.cpus_per_trial,
                "GPU": resources.gpus_per_trial,
                **resources.custom_per_trial,
            }
        )


class TuneTrial(tune.Trainable):
    """A worker process, as Tune sees it; each of its trials is one long step.

    Tune hears of a trial only at its end: a report blocks until the driver has taken it, and whoever wants
    to know more reads the files.
    """

    def setup(self, config: dict[str, Any]) -> None:
        """Get ready for the first trial."""
        self._take(config)

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        """Get ready for the next trial, in the same process."""
        self._take(new_config)
        return True

    def step(self) -> dict[str, Any]:
        """Run the trial to its end or until the sweep is stopped.

        Raises:
            TeacherUnavailableError: the teacher is gone; Tune tries the trial again.
            StorageError: the object store was down for too long; the same.
        """
        from recrl.orchestrator.trial.trial import run_recorded  # noqa: PLC0415  (imports torch; the driver does without)

        if not self._stop_sign.is_set():
            with _given_gpu(), self._place() as trial:
                run_recorded(
                    self._spec,
                    trial,
                    should_stop=self._stop_sign.is_set,
                    teacher=self._teacher,
                    commit_seconds=self._commit_seconds,
                )
        return {"done": True}

    def _place(self) -> AbstractContextManager[TrialStore]:
        """The folder to work in: the trial's own, or one on this machine if it is kept in an object store."""
        if self._kept_at is None:
            return nullcontext(self._store.trial(self._spec))
        return self._kept_at.working_copy(self._spec, self._stop_sign.is_set)

    def _take(self, config: Mapping[str, Any]) -> None:
        self._spec = TrialSpec.from_json(json.loads(config["spec"]))
        sweep = Path(config["sweep"])
        self._store = SweepStore(sweep.parent, sweep.name)
        uri, place = config["storage"], config["stop_sign"]
        self._kept_at = RemoteSweep(uri, sweep.name) if uri else None
        self._stop_sign: StopFile | StopObject = (
            StopObject(self._kept_at.objects, place) if self._kept_at else StopFile(Path(place))
        )
        self._commit_seconds: float = config["commit_seconds"]
        name = config["teacher_service"]
        self._teacher = RayTeacher(self._spec.teacher, find_teacher_service(name)) if name else None


def _given_gpu() -> AbstractContextManager[Any]:
    """Students made meanwhile live on the GPU that Ray gave this worker, if it gave one that can be used."""
    if not ray.get_gpu_ids():
        return nullcontext()
    import torch  # noqa: PLC0415  (the driver does without)

    return torch.device("cuda") if torch.cuda.is_available() else nullcontext()


class StopFile:
    """How one run of a sweep tells its workers, on any node, to checkpoint and stop.

    The file is empty as long as they are to go on; they stop when it says anything, or is gone. It is there
    from the beginning because a network file system may remember for a minute that a file is absent,
    whereas opening one asks the server.

    Attributes:
        path: the file, in the sweep's folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._answer = False
        self._asked_at = float("-inf")

    @property
    def place(self) -> str:
        """By which workers find it."""
        return str(self.path)

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator[StopFile]:
        """The stop file of a new run; whatever may be left of earlier runs is told to stop."""
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("stop-*"):
            old.unlink(missing_ok=True)
        stop_file = cls(folder / f"stop-{secrets.token_hex(4)}")
        stop_file.path.touch()
        try:
            yield stop_file
        finally:
            stop_file.path.unlink(missing_ok=True)

    def set(self) -> None:
        """Tell the workers to stop."""
        self.path.write_text("stop\n")

    def is_set(self) -> bool:
        """Whether to stop; looks at the file every ``STOP_QUESTION_SECONDS`` at most."""
        if not self._answer and time.monotonic() >= self._asked_at + STOP_QUESTION_SECONDS:
            self._asked_at = time.monotonic()
            try:
                self._answer = bool(self.path.read_bytes())
            except FileNotFoundError:
                self._answer = True
        return self._answer


class _Silence:
    """Ends the processes of trials that hang, so that Tune starts these trials again.

    Silence is measured on this process's clock, from when it last saw a heartbeat change: the clocks of the
    nodes need not agree. A process that was given a trial may be silent for longer,
    ``FIRST_WORD_SILENCES``, before it first speaks of it: it may take long to import torch on a busy machine.
    What is on disk until then is an earlier attempt's.
    """

    def __init__(self, store: SweepStore, seconds: float, storage: RemoteSweep | None) -> None:
        self._store = store
        self._seconds = seconds
        self._storage = storage
        self._heard: dict[str, tuple[tuple[int, float], float]] = {}
        self._before: dict[str, tuple[int, float]] = {}
        self._looked_at = float("-inf")

    def begin(self, trial: Any) -> None:
        """A process is given one of Tune's trials."""
        sign = _sign_of(self._store.trial(_spec_of(trial)).record())
        self._before[trial.trial_id] = sign
        self._heard[trial.trial_id] = (sign, time.monotonic())

    def end(self, trials: Sequence[Any]) -> None:
        """End those of Tune's trials whose recrl trial runs without a heartbeat."""
        now = time.monotonic()
        if now < self._looked_at + look_seconds(self._seconds):
            return
        self._looked_at = now
        if self._storage is not None and self._storage.is_out_of_touch(self._seconds):
            self._heard.clear()  # it is this machine that hears nothing
            return
        for trial in trials:
            if trial.status != "RUNNING":
                self._heard.pop(trial.trial_id, None)
                continue
            spec = _spec_of(trial)
            record = self._store.trial(spec).record()
            sign = _sign_of(record)
            last, heard_at = self._heard.get(trial.trial_id, (None, now))
            if sign != last:
                self._heard[trial.trial_id] = (sign, now)
                continue
            has_spoken = sign != self._before.get(trial.trial_id)
            patience = self._seconds * (1 if has_spoken else FIRST_WORD_SILENCES)
            if now - heard_at > patience and (record.status is TrialState.RUNNING or not has_spoken):
                self._heard[trial.trial_id] = (sign, float("inf"))  # once for a silence
                logger.warning("%s: no sign of work for %.0f seconds", spec.title, patience)
                _end_process(record if has_spoken else None, trial.temporary_state.ray_actor)


def _sign_of(record: TrialRecord) -> tuple[int, float]:
    """What changes with every sign of life."""
    return record.attempt, record.heartbeat


def look_seconds(silence_seconds: float) -> float:
    """How long not to look at the heartbeats: each look opens a file for every running trial."""
    return min(max(HEARTBEAT_SECONDS, silence_seconds / 30.0), silence_seconds / 4.0)


def pause_seconds(quiet_seconds: float) -> float:
    """How long to wait before Ray is asked again whether a trial has ended, in seconds.

    Args:
        quiet_seconds: since a trial last began or ended, at least 0; no trial is kept waiting for more than a
            hundredth of them.
    """
    return min(PAUSE_SHARE * quiet_seconds, LONGEST_PAUSE_SECONDS)


def _end_process(record: TrialRecord | None, actor: Any) -> None:
    """Kill a trial's process: directly where it is here, because one that is stopped serves no request.

    Args:
        record: what the process wrote of itself, if it did.
        actor: Ray's handle of it, if there is one.
    """
    if record is not None and record.host == socket.gethostname() and _is_worker(record.pid):
        os.kill(record.pid, signal.SIGKILL)
    elif actor is not None:
        ray.kill(actor)


def _is_worker(pid: int) -> bool:
    """Whether the process is one of Ray's: a number may have been given to another one meanwhile."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::")
    except OSError:
        return False


class _Watch(tune.Callback):
    """What the driver does beside scheduling: passes the stop event on, and records trials given up."""

    def __init__(
        self,
        stop: threading.Event,
        stop_sign: StopFile | StopObject,
        queue: BasicVariantGenerator,
        store: SweepStore,
        silence: _Silence,
        *,
        lost: LostServices,
        storage: RemoteSweep | None,
    ) -> None:
        self._stop = stop
        self._stop_sign = stop_sign
        self._storage = storage
        self._queue = queue
        self._store = store
        self._silence = silence
        self._lost = lost
        self._last_event = time.monotonic()
        self.stopped_and_idle = False

    def on_step_begin(self, iteration: int, trials: list[Any], **info: Any) -> None:
        """Look at the stop event and the heartbeats.

        Tune would call this ten times a second, and each turn of its loop costs a millisecond of a core that
        trials want. So it waits here while trials are long, and never for the stop event.
        """
        self._stop.wait(pause_seconds(time.monotonic() - self._last_event))
        self._lost.check()
        self._silence.end(trials)
        if self._stop.is_set():
            if not self._queue.is_finished():
                self._queue.set_finished()  # type: ignore[no-untyped-call]
            self._stop_sign.set()
            self.stopped_and_idle = all(trial.status != "RUNNING" for trial in trials)

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Look again soon: where one trial begins, others may."""
        self._last_event = time.monotonic()
        self._silence.begin(trial)

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Look again soon: the next trial is to begin."""
        self._last_event = time.monotonic()

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Say that Tune starts a trial again."""
        self._last_event = time.monotonic()
        logger.warning("%s: its process failed; it goes on from its last checkpoint", _spec_of(trial).title)

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Record a trial that Tune gives up; one that only missed its teacher waits to be resumed."""
        self._last_event = time.monotonic()
        cause, spec = _last_error(trial), _spec_of(trial)
        if self._lost.any_is_gone():  # not the trial's fault: it waits
            return
        if isinstance(cause, StorageError):
            logger.warning("%s: %s; it waits", spec.title, cause)
            return
        self._refresh(spec)
        files = self._store.trial(spec)
        if not isinstance(cause, TeacherUnavailableError) and not files.record().status.is_finished:
            error = shown(process_error(cause, trial.num_failures))
            try:
                files.set_status(TrialState.FAILED, error=error)
            except StorageError as also:
                logger.warning("%s; %s", error, also)

    def _refresh(self, spec: TrialSpec) -> None:
        """See to it that the files here say what the storage does."""
        if self._storage is not None:
            try:
                self._storage.pull_trial(self._store, spec)
            except StorageError as error:
                logger.warning("%s", error)

    def __getstate__(self) -> dict[str, Any]:
        """Nothing: Tune pickles its callbacks to restore them, which nobody does, and events cannot be."""
        return {}


class _StopWhenIdle(tune.Stopper):
    """Ends the experiment once the sweep is stopped and the last running trial has come to its end."""

    def __init__(self, watch: _Watch) -> None:
        self._watch = watch

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:
        return False

    def stop_all(self) -> bool:
        return self._watch.stopped_and_idle


@contextmanager
def local_cluster(num_cpus: int | None = None) -> Iterator[None]:
    """A Ray cluster on this machine, for as long as the context lasts, that strangers cannot use.

    Its services listen at the loopback address and want the token, so that neither another machine nor
    another user of this one can use them. Ray opens its own folder to everybody on the machine: the one
    around it, which also holds the token, is only this user's.

    Args:
        num_cpus: cores it may use, at least 1; all of the machine's if None.

    Raises:
        ClusterError: Ray does not start.
    """
    end_processes_of_the_dead(_short_folder())
    with scratch_folder(_short_folder()) as folder:
        token_path = folder / TOKEN
        with open(os.open(token_path, os.O_CREAT | os.O_WRONLY, 0o600), "w") as file:
            file.write(_token())
        seldom = {f"RAY_{name}": str(value) for name, value in SELDOM.items()}
        with _environment(QUIET | WORKER | seldom | {TOKEN_VARIABLE: str(token_path)}):
            for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_ADDRESS"):
                os.environ.pop(name, None)  # Ray looks at its mode only where it sets it itself
            with (
                _leaving_no_process(folder),
                _at_loopback(),
                _connection(
                    "cannot start Ray on this machine",
                    hint="",
                    address="local",
                    num_cpus=num_cpus,
                    _node_ip_address=LOOPBACK,
                    include_dashboard=False,
                    object_store_memory=OBJECT_STORE_BYTES,
                    _temp_dir=str(folder / RAY_FOLDER),
                ),
            ):
                yield


@contextmanager
def existing_cluster(address: str, *, ship_package: bool = False) -> Iterator[None]:
    """A connection to a Ray cluster that somebody else runs.

    Args:
        address: ``auto`` for the one this machine belongs to, or ``host:port``.
        ship_package: whether to send recrl itself, without its dependencies, to the nodes.

    Raises:
        ClusterError: there is none, this machine is no node of it, or it does not know our token.
    """
    failure = f"cannot use the Ray cluster at {address}"
    if "://" in address:  # Ray itself advises against Tune beyond Ray Client
        raise ClusterError(
            f"{failure}: the driver must run on a node of the cluster, not beyond Ray Client; launch there "
            "with --address auto, or make this machine a node: ray start --address=<host:port> --num-cpus=0"
        )
    host, _, port = address.rpartition(":")
    if host:  # Ray itself would try for two minutes
        try:
            socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ClusterError(f"{failure}: {reason}; is it running, and is this host:port?") from error
    hint = (
        "; is this machine a node of it (ray start --address=<host:port> --num-cpus=0), and does it want a "
        "token (RAY_AUTH_MODE=token, RAY_AUTH_TOKEN_PATH=<its token file>)?"
    )
    with scratch_folder(tempfile.gettempdir()) as scratch:
        environment: dict[str, Any] = {"env_vars": WORKER}
        if ship_package:
            environment["py_modules"] = [str(folder) for folder in copy_package(scratch)]
        with _connection(failure, hint, address=address, runtime_env=environment):
            yield


@contextmanager
def _connection(failure: str, hint: str, **settings: Any) -> Iterator[None]:
    try:
        # No public switch keeps Ray from printing a paragraph about every dead process.
        ray._private.worker._worker_logs_enabled = False
        try:
            _connect(**settings)
        except SystemExit as error:  # Ray's own answer to a SIGTERM while it starts; nothing runs yet
            raise KeyboardInterrupt from error
        except Exception as error:
            raise ClusterError(f"{failure}: {_first_line(error)}{hint}") from error
        yield
    finally:
        ray.shutdown()


def _connect(**settings: Any) -> None:
    """``ray.init``, tried again where a busy machine took longer than the seconds that Ray allows."""
    for tries_left in range(CONNECT_TRIES - 1, -1, -1):
        try:
            with _own_signal_handlers(), _own_sessions(), _fewer_processes():
                ray.init(log_to_driver=False, logging_level=logging.CRITICAL, **settings)
            return
        except Exception as error:  # that a node is too slow to start, Ray says by a bare Exception
            if tries_left == 0 or "timed out" not in str(error):
                raise
            logger.warning("Ray did not start in time; it is tried again")
            ray.shutdown()


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Environment variables for a while; whatever is changed meanwhile is undone, also by Ray."""
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextmanager
def _own_signal_handlers() -> Iterator[None]:
    """Undo what Ray and Tune do to this process's signal handlers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGUSR1)}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # None is one that was not installed from Python
                signal.signal(number, handler)


@contextmanager
def _own_sessions() -> Iterator[None]:
    """Start Ray's processes in sessions of their own; Ray has no public switch for it.

    They still end with this process, however it ends: Ray asks the kernel for that.
    """
    services: Any = ray._private.services
    popen = services.ConsolePopen
    services.ConsolePopen = partial(popen, start_new_session=True)
    try:
        yield
    finally:
        services.ConsolePopen = popen


@contextmanager
def _fewer_processes() -> Iterator[None]:
    """Start no process of LEFT_OUT; where a cluster is there already, none is started anyhow."""
    module: Any = ray._private.parameter
    whole = module.RayParams
    known = inspect.signature(whole).parameters
    module.RayParams = partial(whole, **{name: value for name, value in LEFT_OUT.items() if name in known})
    try:
        yield
    finally:
        module.RayParams = whole


@contextmanager
def _leaving_no_process(folder: Path) -> Iterator[None]:
    """End at last what Ray leaves behind of the cluster in a folder: its agents, if its raylet was killed."""
    try:
        yield
    finally:
        end_processes(folder)


@contextmanager
def _at_loopback() -> Iterator[None]:
    """Let Ray's services listen at this machine's own address only.

    Where Ray is told such an address it takes the machine's outer one instead, unless it believes that there
    can be no cluster on this system.
    """
    constants: Any = ray._private.ray_constants
    before = constants.ENABLE_RAY_CLUSTER
    constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        constants.ENABLE_RAY_CLUSTER = before


@cache
def _token() -> str:
    """This process's token for the clusters it starts: Ray reads a process's token only once."""
    return secrets.token_hex(32)


def _short_folder() -> str:
    folder = tempfile.gettempdir()
    return folder if len(folder) <= LONGEST_SOCKET_FOLDER - len("/recrl-12345678/ray") else "/tmp"


def _spec_of(trial: Any) -> TrialSpec:
    """The recrl trial that a Tune trial is."""
    return TrialSpec.from_json(json.loads(trial.config["spec"]))


def _tune_trial_id(trial: Any) -> str:
    return str(trial.trial_id)


def _last_error(trial: Any) -> BaseException | None:
    """What a Tune trial failed of, last."""
    path = trial.pickled_error_file
    if path is None:
        return None
    error: BaseException = cloudpickle.loads(Path(path).read_bytes())  # Tune wrote it a moment ago
    return error.cause if isinstance(error, RayTaskError) else error


def process_error(cause: BaseException | None, failures: int) -> str:
    """What is said of a trial whose processes failed, so often that it is not started again.

    Args:
        cause: what Ray says of the last time, if it does.
        failures: how often, at least 1.
    """
    times = "once" if failures == 1 else f"{failures} times"
    if isinstance(cause, OutOfMemoryError):
        why = "Ray ended it because the machine ran out of memory; let fewer trials run at once"
    elif isinstance(cause, TaskCancelledError):
        why = "Ray cancelled it"
    elif isinstance(cause, ActorDiedError | ActorUnavailableError | WorkerCrashedError | NodeDiedError):
        why = (
            "it ended without a word: killed from outside, for want of memory, or by the task's or the "
            "agent's own code"
        )
    else:
        why = f"{type(cause).__name__}: {_first_line(cause)}" if cause else "nobody says why"
    return f"its process failed {times}; the last time: {why}"


def _first_line(error: BaseException) -> str:
    """The first line, or all of them as one where the first only announces the others."""
    first = next(iter(str(error).splitlines()), "")
    return " ".join(str(error).split()) if first.endswith(":") else first


def _amounts(resources: Mapping[str, float]) -> str:
    """``1 CPU, 0 GPU``."""
    return ", ".join(f"{amount:g} {name}" for name, amount in resources.items())
