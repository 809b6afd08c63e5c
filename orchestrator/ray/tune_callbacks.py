"""Tune callbacks of the driver: pass on the stop event, and record trials that Tune gives up."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from typing import Any

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

from recrl.orchestrator.errors import StorageError, TeacherUnavailableError, first_line
from recrl.orchestrator.files.stop_file import StopSignal
from recrl.orchestrator.ray.hang_watchdog import HangWatchdog
from recrl.orchestrator.ray.services import LostServices
from recrl.orchestrator.ray.tune_trial import spec_of
from recrl.orchestrator.redaction import shown
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace

LONGEST_PAUSE_SECONDS = 0.5  # in which Ray is not asked whether a trial has ended
PAUSE_SHARE = 0.01  # of the time since a trial last began or ended

logger = logging.getLogger("recrl.sweep")


class DriverWatch(tune.Callback):
    """Callback that passes on the stop event, and records trials that Tune gives up."""

    def __init__(
        self,
        place: SweepPlace,
        queue: BasicVariantGenerator,
        *,
        stop: threading.Event,
        stop_signal: StopSignal,
        watchdog: HangWatchdog,
        lost: LostServices,
    ) -> None:
        self._place = place
        self._queue = queue
        self._stop = stop
        self._stop_signal = stop_signal
        self._watchdog = watchdog
        self._lost = lost
        self._last_event = time.monotonic()
        self.stopped_and_idle = False

    def on_step_begin(self, iteration: int, trials: list[Any], **info: Any) -> None:
        """Check the stop event and the heartbeats.

        Tune would call this ten times a second, and each iteration of its loop takes a millisecond of a core.
        So it waits here while trials are long, but not after the stop event.
        """
        self._stop.wait(pause_seconds(time.monotonic() - self._last_event))
        self._lost.check()
        self._watchdog.end(trials)
        if self._stop.is_set():
            if not self._queue.is_finished():
                self._queue.set_finished()  # type: ignore[no-untyped-call]
            self._stop_signal.set()
            self.stopped_and_idle = all(trial.status != "RUNNING" for trial in trials)

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Check again soon: when one trial begins, others may begin as well."""
        self._last_event = time.monotonic()
        self._watchdog.begin(trial)

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Check again soon: the next trial will begin."""
        self._last_event = time.monotonic()

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Log that Tune starts a trial again."""
        self._last_event = time.monotonic()
        logger.warning("%s: its process failed; it continues from its last checkpoint", spec_of(trial).title)

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Record a trial that Tune gives up; if only its teacher was missing, it waits to be resumed."""
        self._last_event = time.monotonic()
        cause, spec = _last_error(trial), spec_of(trial)
        if self._lost.any_is_gone():  # not the trial's fault: it waits
            return
        if isinstance(cause, StorageError):
            logger.warning("%s: %s; it waits", spec.title, cause)
            return
        self._refresh(spec)
        files = self._place.store.trial(spec)
        is_earlier = files.rerun_path.exists()  # the record is that of the run to replace
        is_over = files.record().status.is_finished and not is_earlier
        if not isinstance(cause, TeacherUnavailableError) and not is_over:
            error = shown(process_error(cause, trial.num_failures))
            try:
                files.set_status(TrialStatus.FAILED, error=error)
            except StorageError as also:
                logger.warning("%s; %s", error, also)

    def _refresh(self, spec: TrialSpec) -> None:
        """Bring the trial's folder up to date."""
        try:
            self._place.pull_trial(spec)
        except StorageError as error:
            logger.warning("%s", error)

    def __getstate__(self) -> dict[str, Any]:
        """Return an empty state: events cannot be pickled, and the callbacks are never restored."""
        return {}


class StopWhenIdle(tune.Stopper):
    """Stopper that ends the experiment once the sweep is stopped and no trial runs."""

    def __init__(self, watch: DriverWatch) -> None:
        self._watch = watch

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:
        """Stop no single trial."""
        return False

    def stop_all(self) -> bool:
        """Return whether the sweep is stopped and no trial runs."""
        return self._watch.stopped_and_idle


def pause_seconds(quiet_seconds: float) -> float:
    """Return the time until Ray is asked again whether a trial has ended, in seconds.

    Args:
        quiet_seconds: since a trial last began or ended, at least 0; a trial waits for at most a hundredth of
            it.
    """
    return min(PAUSE_SHARE * quiet_seconds, LONGEST_PAUSE_SECONDS)


def _last_error(trial: Any) -> BaseException | None:
    """Return the last error of a Tune trial."""
    path = trial.pickled_error_file
    if path is None:
        return None
    # written a moment ago; Trial.get_pickled_error would look in the storage, where it is not yet
    error: BaseException = cloudpickle.loads(Path(path).read_bytes())
    return error.cause if isinstance(error, RayTaskError) else error


def process_error(cause: BaseException | None, failures: int) -> str:
    """Describe a trial that is not started again, because its processes failed too often.

    Args:
        cause: Ray's description of the last failure, if any.
        failures: number of failures, at least 1.
    """
    times = "once" if failures == 1 else f"{failures} times"
    if isinstance(cause, OutOfMemoryError):
        why = "Ray ended it because the machine ran out of memory; let fewer trials run at once"
    elif isinstance(cause, TaskCancelledError):
        why = "Ray cancelled it"
    elif isinstance(cause, ActorDiedError | ActorUnavailableError | WorkerCrashedError | NodeDiedError):
        why = (
            "it ended without an error: killed from outside, out of memory, or ended by the "
            "task's or the agent's own code"
        )
    else:
        why = f"{type(cause).__name__}: {first_line(cause)}" if cause else "the reason is unknown"
    return f"its process failed {times}; the last time: {why}"
