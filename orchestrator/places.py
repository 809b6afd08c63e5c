"""Where a sweep is kept: in its folder, or in an object store that the folder copies.

A launch, its executors and the commands use a ``SweepPlace`` and do not ask which of the two it is. The
object store's is ``remote.remote_sweep.RemoteSweep``; ``remote.opening`` chooses.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from recrl.orchestrator.files.stop_file import StopFile
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec


class StopSign(Protocol):
    """How one run of a sweep tells its workers, on any node, to save and stop."""

    @property
    def place(self) -> str:
        """By which workers find it: see ``SweepPlace.stop_sign_at``."""
        ...

    @property
    def uri(self) -> str:
        """The address of the sweep in an object store, or empty."""
        ...

    def set(self) -> None:
        """Tell the workers to stop."""
        ...

    def is_set(self) -> bool:
        """Return whether to stop; may be asked often."""
        ...


class SweepPlace(Protocol):
    """Where the trials of a sweep are kept, as seen from one machine."""

    @property
    def store(self) -> SweepStore:
        """The sweep's folder on this machine: the sweep itself, or a copy."""
        ...

    @property
    def uri(self) -> str:
        """The address of all sweeps in the object store, or empty."""
        ...

    @property
    def address(self) -> str:
        """The address of this sweep in the object store, or empty."""
        ...

    def prepare(self) -> None:
        """Find out whether the place can be used, before any work.

        Raises:
            RecrlError: it cannot.
        """
        ...

    def require_reruns(self) -> None:
        """Find out whether trials that have ended can be run again here.

        Raises:
            RecrlError: they cannot.
        """
        ...

    def held(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Be the one launch, on all machines, that runs the sweep; its folder is locked already.

        Args:
            stop: set when somebody asks for it on another machine, or has taken the sweep over.

        Raises:
            SweepBusyError: another launch runs the sweep.
        """
        ...

    def pull(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date.

        Args:
            checkpoints: whether to bring those of trials that still run.
        """
        ...

    def refresh(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date for somebody who looks; log a warning if that is impossible."""
        ...

    def publish(self) -> None:
        """Send what the folder says of the sweep itself."""
        ...

    def kept_up_to_date(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Keep the folder up to date while the body runs, and once more after it."""
        ...

    def settle(self, specs: Sequence[TrialSpec]) -> None:
        """Send what only this machine knows of trials that nobody runs: that their process died."""
        ...

    def request_stop(self) -> Callable[[], bool]:
        """Ask the launch that runs the sweep, on whatever machine, to save its trials and end.

        Returns:
            A function that says whether it still runs.
        """
        ...

    def pull_trial(self, spec: TrialSpec) -> None:
        """Bring one trial in the folder up to date."""
        ...

    def is_out_of_touch(self, silence_seconds: float) -> bool:
        """Return whether the folder is so old that a silence of so many seconds in it says nothing."""
        ...

    def working_copy(
        self, spec: TrialSpec, should_stop: Callable[[], bool]
    ) -> AbstractContextManager[TrialStore]:
        """Return a folder for one attempt at a trial, on the machine that runs it."""
        ...

    def new_stop_sign(self) -> AbstractContextManager[StopSign]:
        """Return the stop sign of a new run; workers of earlier runs are told to stop."""
        ...

    def stop_sign_at(self, place: str) -> StopSign:
        """Return the stop sign that a run has made: its ``StopSign.place``."""
        ...


@dataclass(frozen=True)
class LocalSweep:
    """A sweep that is kept in its folder; every node sees the folder under the same path.

    Attributes:
        store: the folder.
    """

    store: SweepStore
    uri = ""
    address = ""

    def prepare(self) -> None:
        """See ``SweepPlace``; nothing to do, as the other methods without a body."""

    def require_reruns(self) -> None:
        """See ``SweepPlace``."""

    def held(self, stop: threading.Event) -> AbstractContextManager[None]:
        """See ``SweepPlace``; the folder's lock is enough."""
        return nullcontext()

    def pull(self, *, checkpoints: bool = False) -> None:
        """See ``SweepPlace``."""

    def refresh(self, *, checkpoints: bool = False) -> None:
        """See ``SweepPlace``."""

    def publish(self) -> None:
        """See ``SweepPlace``."""

    def kept_up_to_date(self, stop: threading.Event) -> AbstractContextManager[None]:
        """See ``SweepPlace``."""
        return nullcontext()

    def settle(self, specs: Sequence[TrialSpec]) -> None:
        """See ``SweepPlace``."""

    def request_stop(self) -> Callable[[], bool]:
        """See ``SweepPlace``."""
        if self.store.is_locked():
            self.store.stop_request_path.touch()
        return self.store.is_locked

    def pull_trial(self, spec: TrialSpec) -> None:
        """See ``SweepPlace``."""

    def is_out_of_touch(self, silence_seconds: float) -> bool:
        """See ``SweepPlace``; never."""
        return False

    def working_copy(
        self, spec: TrialSpec, should_stop: Callable[[], bool]
    ) -> AbstractContextManager[TrialStore]:
        """See ``SweepPlace``; the trial's own folder."""
        return nullcontext(self.store.trial(spec))

    def new_stop_sign(self) -> AbstractContextManager[StopSign]:
        """See ``SweepPlace``."""
        return StopFile.open(self.store.folder)

    def stop_sign_at(self, place: str) -> StopSign:
        """See ``SweepPlace``."""
        return StopFile(Path(place))
