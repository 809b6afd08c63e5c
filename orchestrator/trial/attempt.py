"""Run a trial in this process: take it over, write heartbeat and log, and record its end."""

from __future__ import annotations

import logging
import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from io import TextIOWrapper

from recrl.agents.evaluation import StoppedError
from recrl.orchestrator.errors import (
    USERS_ERRORS,
    LostLeaseError,
    StorageError,
    TeacherUnavailableError,
    described_with_place,
)
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.files.trial_writer import COMMIT_SECONDS, TrialWriter
from recrl.orchestrator.provenance.code_changes import code_of
from recrl.orchestrator.provenance.versions import collect as collect_provenance
from recrl.orchestrator.redaction import shown
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.trial.device import device_name, learning_on
from recrl.orchestrator.trial.heartbeat import Heartbeat
from recrl.orchestrator.trial.torch_settings import torch_settings
from recrl.orchestrator.trial.trial import Trial
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import Teacher

HEARTBEAT_SECONDS = 2.0
SPEED_SECONDS = 30.0  # of updates whose mean speed is shown

logger = logging.getLogger("recrl.trial")


def run_trial(
    spec: TrialSpec,
    writer: TrialWriter,
    teacher: Teacher,
    *,
    should_stop: Callable[[], bool],
    commit_seconds: float = COMMIT_SECONDS,
) -> TrialStatus:
    """Run a trial to its end, or until ``should_stop``, from its newest checkpoint.

    Args:
        spec: the trial.
        writer: the lease on its folder (``TrialStore.begin``).
        teacher: sets the limits; inline, or a proxy of a remote teacher.
        should_stop: called after every update and during the evaluation; once true, the trial is saved and
            left waiting.
        commit_seconds: wall seconds between checkpoints; has no influence on results.

    Returns:
        COMPLETE, or WAITING if it was stopped.

    Raises:
        LostLeaseError: another attempt took over the trial.
        StorageError: the disk is full or gone; the last commit is intact.
        Exception: raised by the task, the agent or the teacher, with a note on the update; the last commit is
            intact.
    """
    life, evaluated = _SignsOfLife(writer), False
    heartbeat = Heartbeat(life.beat, seconds=HEARTBEAT_SECONDS)
    with heartbeat.beating(), ExitStack() as at_end:  # preparation may take minutes
        trial = life.of(at_end.enter_context(closing(Trial(spec, writer, teacher))))
        if len(trial.cost_names) > 1:
            writer.add_provenance({"cost_names": list(trial.cost_names)})  # for titles
        committed = time.monotonic()
        while not trial.learned and not should_stop():
            with _located(f"in update {trial.update + 1}", writer):
                trial.advance()
            life.advanced()
            heartbeat.check()
            if time.monotonic() - committed >= commit_seconds:
                trial.save()
                committed = time.monotonic()
        trial.save()
        if trial.learned:
            with _located("in the evaluation", writer), suppress(StoppedError):
                trial.evaluate(should_stop)
                trial.save()
                evaluated = True
    if not evaluated:
        writer.close(TrialStatus.WAITING)
        logger.info("stopped after update %d; it can be resumed", trial.update)
        return TrialStatus.WAITING
    writer.close(TrialStatus.COMPLETE)
    logger.info("complete: %d updates, %d environment steps", trial.update, trial.env_steps)
    return TrialStatus.COMPLETE


class _SignsOfLife:
    """Content of a trial's heartbeat: its progress, and its speed over the last updates."""

    def __init__(self, writer: TrialWriter) -> None:
        self._writer = writer
        self._trial: Trial | None = None
        self._ends = deque[tuple[float, int]]()  # times of the last ends of updates, and environment steps

    def of(self, trial: Trial) -> Trial:
        """Set the trial once it is made; before, the heartbeat has its recorded progress."""
        self._ends.append((time.monotonic(), trial.env_steps))
        self._trial = trial
        return trial

    def advanced(self) -> None:
        """Note the end of an update of the trial."""
        assert self._trial is not None
        now = time.monotonic()
        self._ends.append((now, self._trial.env_steps))
        while len(self._ends) > 2 and self._ends[1][0] <= now - SPEED_SECONDS:
            self._ends.popleft()

    def beat(self) -> None:
        """Write it."""
        done = self._writer.record if self._trial is None else self._trial
        self._writer.heartbeat(update=done.update, env_steps=done.env_steps, steps_per_second=self._speed())

    def _speed(self) -> float:
        """Return the steps per second of whole updates, over ``SPEED_SECONDS`` or more if possible."""
        if len(self._ends) < 2:
            return 0.0
        (began, before), (ended, after) = self._ends[0], self._ends[-1]
        return (after - before) / (ended - began)


@contextmanager
def _located(where: str, writer: TrialWriter) -> Iterator[None]:
    """Add a note to any error: the update, and the last checkpoint."""
    try:
        yield
    except USERS_ERRORS as error:
        update = writer.store.saved_update
        saved = (
            f"the last good checkpoint is that of update {update}" if update else "no checkpoint before it"
        )
        error.add_note(f"{where}; {saved}")
        raise


@torch_settings()  # equal bytes on all machines, and no load on other trials' cores
def run_recorded(
    spec: TrialSpec,
    store: TrialStore,
    *,
    should_stop: Callable[[], bool],
    is_interrupted: Callable[[], bool] = lambda: False,
    teacher: Teacher | None = None,
    commit_seconds: float = COMMIT_SECONDS,
    on_gpu: bool = False,
) -> TrialStatus:
    """Call ``run_trial``, and record the run in the trial's folder.

    A trial that raises is FAILED in its own files, with the traceback in ``error.txt``. Its error is not
    raised here, so that it does not stop other trials. With a full disk the trial waits instead, and the same
    launch continues from its last commit once there is room.

    Args:
        spec: the trial.
        store: the trial's folder.
        should_stop: see ``run_trial``.
        is_interrupted: called after an error; if true, it came from SIGTERM to this process, which interrupts
            any code, and the trial waits.
        teacher: sets the limits; made from the spec if None.
        commit_seconds: see ``run_trial``.
        on_gpu: whether to learn on CUDA. A trial that cannot is FAILED.

    Returns:
        The new status of the trial.

    Raises:
        TeacherUnavailableError: the teacher does not answer; the trial waits to be resumed.
        SystemExit: of SIGTERM, before the trial began or while its end was recorded.
    """
    # waits for git without a heartbeat, so before the trial begins
    provenance = {**collect_provenance(), "code": code_of(spec)}
    try:
        writer = store.begin(spec)
    except StorageError as error:
        logger.warning("%s", error)
        return TrialStatus.WAITING
    with _log_to(store):
        try:
            writer.add_provenance({**provenance, "device": device_name(on_gpu=on_gpu)})
            with learning_on(gpu=on_gpu):
                return run_trial(
                    spec,
                    writer,
                    teacher or make_teacher(spec.teacher),
                    should_stop=should_stop,
                    commit_seconds=commit_seconds,
                )
        except LostLeaseError as error:
            logger.warning("%s", error)
        except TeacherUnavailableError:
            _close(writer, TrialStatus.WAITING)
            raise
        except StorageError as error:
            logger.error("%s", error)
            return _close(writer, TrialStatus.WAITING, error=str(error))
        except USERS_ERRORS as error:
            if is_interrupted():
                logger.warning("the process got SIGTERM; the trial waits to be resumed")
                return _close(writer, TrialStatus.WAITING)
            logger.exception("failed; rows and checkpoint end at the last commit")
            notes = "".join(f" ({note})" for note in getattr(error, "__notes__", ()))
            text = shown(f"{described_with_place(error)}{notes}")
            return _close(writer, TrialStatus.FAILED, error=text, traceback=shown(traceback.format_exc()))
        return store.record().status


def _close(writer: TrialWriter, status: TrialStatus, *, error: str = "", traceback: str = "") -> TrialStatus:
    """End an attempt after an error; a failure to record it must not hide the error."""
    try:
        writer.close(status, error=error, traceback=traceback)
    except (LostLeaseError, StorageError) as also:
        logger.warning("%s", also)
    return status


@contextmanager
def _log_to(store: TrialStore) -> Iterator[None]:
    """Write the log of this process's trial to its folder."""
    handler = _Log(store.log_path, encoding="utf-8", delay=True)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    root = logging.getLogger("recrl")
    level = root.level
    root.setLevel(logging.INFO)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(level)
        with suppress(OSError):
            handler.close()


class _Log(logging.FileHandler):
    """A log file that loses lines, for example on a full disk, instead of ending a trial.

    A link is not followed: it might lead to another file of the user.
    """

    def _open(self) -> TextIOWrapper:
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
        return open(os.open(self.baseFilename, flags, 0o644), "a", encoding=self.encoding)

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as text, without secrets and control characters."""
        return shown(super().format(record))

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):
            super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (logging's name)
        pass
