"""A launch: the one place that makes what is on disk match a grid.

First run, resume after a crash, retry of what failed and more seeds are the same call. The lock sees to it
that there is one at a time; the plan says what is to do; the executor does it; what came of it is read back
from the files.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Protocol

from recrl.orchestrator.background import beside
from recrl.orchestrator.errors import DamagedError, RecrlError, StorageError
from recrl.orchestrator.executors import Executor
from recrl.orchestrator.files.provenance import collect
from recrl.orchestrator.files.store import SweepStore
from recrl.orchestrator.grid.grid import GridSpec
from recrl.orchestrator.grid.plan import Plan, Work, make_plan
from recrl.orchestrator.spec import TrialSpec, TrialState
from recrl.orchestrator.status import Standing, SweepProgress, TrialProgress, progress

if TYPE_CHECKING:
    from recrl.orchestrator.remote.remote_sweep import RemoteSweep

# How long the mirror may take for its last pass: after the whole sweep, and when someone wants to stop.
MIRROR_SECONDS = 120.0
HASTY_MIRROR_SECONDS = 10.0
REQUEST_SECONDS = 0.5  # between two looks whether somebody asks to stop, or has been heard

logger = logging.getLogger("recrl.sweep")


class Mirror(Protocol):
    """Something that shows the sweep elsewhere while it runs."""

    def stop(self, timeout: float) -> bool:
        """Show what is left, and end; says whether everything is shown.

        Args:
            timeout: seconds it may take, at least 0.
        """
        ...


@dataclass(frozen=True)
class SweepResult:
    """What came of a launch.

    Attributes:
        plan: what there was to do.
        progress: where the chosen trials stand now.
        stopped: whether it was asked to stop before its end.
        mirrored: whether the mirror shows everything; None if there was none.
    """

    plan: Plan
    progress: SweepProgress
    stopped: bool
    mirrored: bool | None

    @property
    def failed(self) -> tuple[TrialProgress, ...]:
        """The trials that stand as failed, also from earlier launches."""
        return self.progress.standing(Standing.FAILED)


def launch(
    grid: GridSpec,
    store: SweepStore,
    executor: Executor,
    *,
    stop: threading.Event,
    only: Mapping[str, Sequence[str]] | None = None,
    retry_failed: bool = False,
    rerun_damaged: bool = False,
    rerun_changed: bool = False,
    storage: RemoteSweep | None = None,
    start_mirror: Callable[[SweepStore], Mirror] | None = None,
    watch: Callable[[Plan], None] | None = None,
    finish: Callable[[SweepProgress], None] | None = None,
) -> SweepResult:
    """Work on everything in the grid that is not finished.

    Args:
        grid: the checked grid.
        store: the sweep's folder.
        executor: who runs the trials.
        stop: once set, running trials save where they are, and the call returns.
        only: the trials to work on, as ``plan.select`` reads it; all by default.
        retry_failed: whether failed trials are tried again.
        rerun_damaged: whether damaged trials that were complete or failed are run again.
        rerun_changed: whether trials that ran other code than is installed now are run again.
        storage: where the trials are kept, if ``store`` is only a mirror; the executor's as well.
        start_mirror: begins to show the sweep elsewhere, before the first trial.
        watch: told the plan before the first trial.
        finish: called after the last trial, before the mirror stops: draws figures, for example.

    Raises:
        SweepBusyError: another process is running this sweep.
        StorageError: the storage cannot be used.
        RecrlError: ``only`` names what is not in the grid, or the executor cannot run at all.
    """
    if storage is not None and (rerun_damaged or rerun_changed):
        raise RecrlError(
            f"{storage.uri}: trials of a sweep that is kept there are not run again: give the sweep another "
            "name; if only its folder here is damaged, delete that, and it is fetched again"
        )
    specs = grid.trials()
    make_plan(specs, store, only=only)  # a mistake in ``only`` leaves no trace
    with store.lock(), _stopping_on_request(store, stop), _held(storage, stop):
        if storage is not None:
            storage.pull(store)
        _write_files(grid, specs, store)
        if storage is not None:
            storage.publish(store)
        _leave_none_running(specs, store)  # of a launch that died
        plan = make_plan(
            specs,
            store,
            only=only,
            retry_failed=retry_failed,
            rerun_damaged=rerun_damaged,
            rerun_changed=rerun_changed,
        )
        chosen = [trial.spec for trial in plan.trials]
        if watch is not None:
            watch(plan)
        for trial in plan.doing(Work.RERUN):
            store.trial(trial.spec).set_all_aside()
        mirror = start_mirror(store) if start_mirror is not None else None
        patience = HASTY_MIRROR_SECONDS
        mirrored: bool | None = None
        try:
            try:
                with _mirrored(storage, store, stop):
                    executor.run(plan.to_do, store, stop)
            finally:
                _leave_none_running(plan.to_do, store)
                _settle(plan.to_do, store, storage)
            after = progress(chosen, store)
            if finish is not None:
                finish(after)
            if not stop.is_set():
                patience = MIRROR_SECONDS
        finally:
            if mirror is not None:
                mirrored = mirror.stop(patience)
    return SweepResult(plan, after, stopped=stop.is_set(), mirrored=mirrored)


def request_stop(store: SweepStore, storage: RemoteSweep | None = None) -> Callable[[], bool]:
    """Ask the launch that runs the sweep, on whatever machine, to save its trials and end.

    Args:
        store: the sweep's folder.
        storage: what that is the mirror of, if it is one.

    Returns:
        Whether it still runs; to be asked until it does not.
    """
    if store.is_locked():
        store.stop_request_path.touch()
    elif storage is not None and storage.is_held():
        storage.request_stop()
        return storage.is_held
    return store.is_locked


def _held(storage: RemoteSweep | None, stop: threading.Event) -> AbstractContextManager[None]:
    return storage.held(stop) if storage else nullcontext()


def _mirrored(
    storage: RemoteSweep | None, store: SweepStore, stop: threading.Event
) -> AbstractContextManager[None]:
    return storage.mirrored(store, stop) if storage else nullcontext()


def _settle(specs: Sequence[TrialSpec], store: SweepStore, storage: RemoteSweep | None) -> None:
    """Tell the storage what only this machine knows; it must not hide what came before."""
    if storage is not None:
        try:
            storage.settle(specs, store)
        except StorageError as error:
            logger.warning("%s; how its trials ended is known on this machine only", error)


@contextmanager
def _stopping_on_request(store: SweepStore, stop: threading.Event) -> Iterator[None]:
    """Set ``stop`` when ``request_stop`` is called, in whatever process; what was asked before is void."""

    def watch(over: threading.Event) -> None:
        while not over.wait(REQUEST_SECONDS):
            if store.stop_request_path.exists():
                stop.set()
                return

    store.stop_request_path.unlink(missing_ok=True)
    try:
        with beside(watch, name="stop request"):
            yield
    finally:
        store.stop_request_path.unlink(missing_ok=True)


@contextmanager
def stopping_on_signals(stop: threading.Event, say: Callable[[], None]) -> Iterator[None]:
    """Set ``stop`` on the first SIGINT or SIGTERM, raise KeyboardInterrupt on the second, die of the third.

    Args:
        stop: what a launch looks at.
        say: called on the first signal.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            for signum in signals:
                signal.signal(signum, signal.SIG_DFL)
            raise KeyboardInterrupt
        stop.set()
        say()

    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, handle) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _write_files(grid: GridSpec, specs: Sequence[TrialSpec], store: SweepStore) -> None:
    """Say in the sweep's folder what it is."""
    try:
        created = store.info().get("created", time.time())
    except DamagedError as error:
        logger.warning("%s; to MLflow the sweep is a new one", error)
        created = time.time()
    store.write_info({"name": grid.name, "created": created, "launched": time.time(), **collect()})
    store.write_specs(specs, grid.text)


def _leave_none_running(specs: Sequence[TrialSpec], store: SweepStore) -> None:
    """Nobody works on these trials: one whose files still say so waits to be resumed."""
    for spec in specs:
        files = store.trial(spec)
        if files.record().status is TrialState.RUNNING:
            try:
                files.set_status(TrialState.WAITING)
            except StorageError as error:  # the next launch says it; nothing that came before is hidden
                logger.warning("%s", error)
