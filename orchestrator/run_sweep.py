"""A launch runs the trials of a grid that its plan (``launch_plan``) selects.

First run, resume after a crash, retry of failed trials and more seeds are the same call. A lock permits one
launch at a time. The plan compares the grid with the files, the executor runs the trials, and the results
are read from the files.
"""

from __future__ import annotations

import logging
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass, field
from types import FrameType
from typing import Protocol

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import DamagedError, StorageError
from recrl.orchestrator.executors import Executor
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.only_selection import select
from recrl.orchestrator.launch_plan import Plan, PlannedAction, TrialSelection, make_plan
from recrl.orchestrator.provenance.versions import collect
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.sweep_progress import DisplayStatus, SweepProgress, TrialProgress, progress

# Timeout of the MLflow sync for its last pass: after the whole sweep, and after a stop request.
SYNC_SECONDS = 120.0
HASTY_SYNC_SECONDS = 10.0
REQUEST_SECONDS = 0.5  # between two checks for a stop request
ONE_SIGNAL_SECONDS = 0.5  # see ``stopping_on_signals``

logger = logging.getLogger("recrl.sweep")


class RunningSync(Protocol):
    """A process that copies the sweep to MLflow while it runs."""

    def stop(self, timeout: float) -> bool:
        """Copy the remaining results and end; return whether all are copied.

        Args:
            timeout: seconds, at least 0.
        """
        ...


@dataclass(frozen=True)
class SweepResult:
    """Result of a launch.

    Attributes:
        plan: the plan of the launch.
        progress: of the selected trials.
        stopped: whether it was stopped before its end.
        synced: whether MLflow is up to date; None without MLflow.
    """

    plan: Plan
    progress: SweepProgress
    stopped: bool
    synced: bool | None

    @property
    def failed(self) -> tuple[TrialProgress, ...]:
        """The trials with the status failed, also from earlier launches."""
        return self.progress.with_status(DisplayStatus.FAILED)


@dataclass(frozen=True)
class SweepRunSettings:
    """Settings of a launch.

    Attributes:
        grid: the checked grid.
        place: of the sweep's files.
        executor: runs the trials.
        selection: the trials to run.
        start_sync: starts the MLflow sync, before the first trial.
        watch: called with the plan before the first trial.
        finish: called after the last trial, before the sync stops: draws figures, for example.
    """

    grid: GridSpec
    place: SweepPlace
    executor: Executor
    selection: TrialSelection = field(default_factory=TrialSelection)
    start_sync: Callable[[SweepStore], RunningSync] | None = None
    watch: Callable[[Plan], None] = lambda plan: None
    finish: Callable[[SweepProgress], None] = lambda after: None


def run_sweep(settings: SweepRunSettings, *, stop: threading.Event) -> SweepResult:
    """Run all trials of a grid that are not finished.

    Args:
        settings: of the launch.
        stop: once set, running trials save their state, and the call returns.

    Raises:
        SweepBusyError: another process is running this sweep.
        StorageError: the object store cannot be used.
        RecrlError: ``only`` matches no trial, the trials cannot be run again in their storage, or the
            executor cannot run.
    """
    place, store = settings.place, settings.place.store
    if settings.selection.reruns:
        place.require_reruns()
    specs = settings.grid.trials()
    select(specs, settings.selection.only)  # a mistake in ``only`` must leave no files
    place.prepare()
    with store.lock(), _stopping_on_request(store, stop), place.held(stop):
        place.pull()
        _write_files(settings.grid, specs, store)
        place.publish()
        _leave_none_running(specs, store)  # trials of a launch that died
        _withdraw_reruns(specs, store)
        plan = make_plan(specs, store, settings.selection)
        settings.watch(plan)
        return _run(settings, plan, stop)


def _run(settings: SweepRunSettings, plan: Plan, stop: threading.Event) -> SweepResult:
    """Run the trials of a plan, with the MLflow sync in the background."""
    store = settings.place.store
    sync = settings.start_sync(store) if settings.start_sync is not None else None
    synced: bool | None = None
    patience = HASTY_SYNC_SECONDS  # also after an error
    try:
        with _reruns_requested(plan, store):
            _run_trials(settings, plan.to_do, stop)
        after = progress([trial.spec for trial in plan.trials], store)
        settings.finish(after)
        if not stop.is_set():
            patience = SYNC_SECONDS
    finally:
        if sync is not None:
            synced = sync.stop(patience)
    return SweepResult(plan, after, stopped=stop.is_set(), synced=synced)


@contextmanager
def _reruns_requested(plan: Plan, store: SweepStore) -> Iterator[None]:
    """Request the planned reruns; withdraw the requests of trials that no attempt has begun by the end.

    So a complete trial keeps its results until its new attempt begins, whatever stops the launch.
    """
    specs = [trial.spec for trial in plan.with_action(PlannedAction.RERUN)]
    try:
        for spec in specs:
            store.trial(spec).request_rerun()
        yield
    finally:
        _withdraw_reruns(specs, store)


def _withdraw_reruns(specs: Sequence[TrialSpec], store: SweepStore) -> None:
    """Withdraw the requests to run trials again, also those of a launch that died."""
    for spec in specs:
        try:
            store.trial(spec).withdraw_rerun()
        except StorageError as error:  # must not hide an earlier error
            logger.warning("%s", error)


def _run_trials(settings: SweepRunSettings, specs: Sequence[TrialSpec], stop: threading.Event) -> None:
    """Run trials; afterwards none of them has the status running, also after an error."""
    place = settings.place
    try:
        with place.kept_up_to_date(stop):
            settings.executor.run(specs, place, stop)
    finally:
        _leave_none_running(specs, place.store)
        try:
            place.send_dead_trials(specs)
        except StorageError as error:  # must not hide an earlier error
            logger.warning("%s; the end of its trials is recorded on this machine only", error)


@contextmanager
def _stopping_on_request(store: SweepStore, stop: threading.Event) -> Iterator[None]:
    """Set ``stop`` on a ``SweepPlace.request_stop`` from any process; earlier requests are void."""

    def watch(over: threading.Event) -> None:
        while not over.wait(REQUEST_SECONDS):
            with suppress(OSError):  # the disk may come back
                if store.stop_request_path.exists():
                    stop.set()
                    return

    store.stop_request_path.unlink(missing_ok=True)
    try:
        with background_thread(watch, name="stop request"):
            yield
    finally:
        store.stop_request_path.unlink(missing_ok=True)


@contextmanager
def stopping_on_signals(stop: threading.Event, say: Callable[[], None]) -> Iterator[None]:
    """Set ``stop`` on the first SIGINT or SIGTERM; the second raises KeyboardInterrupt, the third kills.

    A signal may interrupt the main thread anywhere: while it prints, holds the lock of ``stop``, or handles
    another signal. So the handler does only what may be interrupted, and another thread does the rest.
    Signals within ``ONE_SIGNAL_SECONDS`` count as one: a process may get them from its group and its parent.

    Args:
        stop: the event of the launch.
        say: called on the first signal, in that thread.
    """
    first: queue.SimpleQueue[bool] = queue.SimpleQueue()
    times: list[float] = []

    def answer() -> None:
        if first.get():
            stop.set()
            say()

    def handle(number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if times and now - times[-1] <= ONE_SIGNAL_SECONDS:
            return
        times.append(now)
        if len(times) == 1:
            first.put(True)
        elif len(times) == 2:
            raise KeyboardInterrupt
        else:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    context = copy_context()  # it refuses import paths if this thread does
    answering = threading.Thread(target=context.run, args=(answer,), name="recrl-stopping", daemon=True)
    answering.start()

    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, handle) for number in signals}
    try:
        yield
    finally:
        if len(times) > 1:  # its duplicates must not reach the handlers of before
            time.sleep(max(0.0, times[-1] + ONE_SIGNAL_SECONDS - time.monotonic()))
        for number, handler in before.items():
            # None stands for a handler that was not installed from Python, and cannot be installed from it
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        first.put(False)
        answering.join()


def _write_files(grid: GridSpec, specs: Sequence[TrialSpec], store: SweepStore) -> None:
    """Write the sweep's own files; a renamed or copied sweep becomes another one."""
    created = time.time()
    try:
        info = store.info()
        if info.get("name") == grid.name:
            created = info["created"]
    except DamagedError as error:
        logger.warning("%s; MLflow shows it as a new sweep", error)
    launch = {"name": grid.name, "created": created, "launched": time.time()}
    store.write_info({**launch, "silence_seconds": grid.resources.silence_seconds, **collect()})
    store.write_specs(specs, grid.text)


def _leave_none_running(specs: Sequence[TrialSpec], store: SweepStore) -> None:
    """Set trials with the status running to waiting: no process runs them."""
    for spec in specs:
        files = store.trial(spec)
        if files.record().status is TrialStatus.RUNNING:
            try:
                files.set_status(TrialStatus.WAITING)
            except StorageError as error:  # the next launch reports it; an earlier error is not hidden
                logger.warning("%s", error)
