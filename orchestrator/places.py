"""Where a sweep is kept: in its folder, or in an object store that the folder copies.

A launch, its executors and the commands use a ``SweepPlace`` and do not ask which of the two it is. The
object store's is ``remote.remote_sweep.RemoteSweep``; ``remote.opening`` chooses.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from recrl.orchestrator.files.stop_file import StopFile, StopSign
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec


class SweepPlace:
    """Where the trials of a sweep are kept, as seen from one machine; here the sweep's folder.

    Every node sees the folder under the same path, so most methods have nothing to do.

    Attributes:
        store: the sweep's folder on this machine: the sweep itself, or a copy.
        uri: the address of all sweeps in the object store, or empty.
    """

    uri = ""

    def __init__(self, store: SweepStore) -> None:
        self.store = store

    @property
    def address(self) -> str:
        """The address of this sweep in the object store, or empty."""
        return ""

    def prepare(self) -> None:
        """Find out whether the place can be used, before any work.

        Raises:
            RecrlError: it cannot.
        """

    def require_reruns(self) -> None:
        """Find out whether trials that have ended can be run again here.

        Raises:
            RecrlError: they cannot.
        """

    def held(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Be the one launch, on all machines, that runs the sweep; its folder is locked already.

        Args:
            stop: set when somebody asks for it on another machine, or has taken the sweep over.

        Raises:
            SweepBusyError: another launch runs the sweep.
        """
        return nullcontext()

    def pull(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date.

        Args:
            checkpoints: whether to bring those of trials that still run.
        """

    def refresh(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date for somebody who looks; log a warning if that is impossible."""

    def publish(self) -> None:
        """Send what the folder says of the sweep itself."""

    def kept_up_to_date(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Keep the folder up to date while the body runs, and once more after it."""
        return nullcontext()

    def settle(self, specs: Sequence[TrialSpec]) -> None:
        """Send what only this machine knows of trials that nobody runs: that their process died."""

    def request_stop(self) -> Callable[[], bool]:
        """Ask the launch that runs the sweep, on whatever machine, to save its trials and end.

        Returns:
            A function that says whether it still runs.
        """
        if self.store.is_locked():
            self.store.stop_request_path.touch()
        return self.store.is_locked

    def pull_trial(self, spec: TrialSpec) -> None:
        """Bring one trial in the folder up to date."""

    def is_out_of_touch(self, silence_seconds: float) -> bool:
        """Return whether the folder is so old that a silence of so many seconds in it says nothing."""
        return False

    def working_copy(
        self, spec: TrialSpec, should_stop: Callable[[], bool]
    ) -> AbstractContextManager[TrialStore]:
        """Return a folder for one attempt at a trial, on the machine that runs it."""
        return nullcontext(self.store.trial(spec))

    def new_stop_sign(self) -> AbstractContextManager[StopSign]:
        """Return the stop sign of a new run; workers of earlier runs are told to stop."""
        return StopFile.open(self.store.folder)

    def stop_sign_at(self, place: str) -> StopSign:
        """Return the stop sign that a run has made: its ``StopSign.place``."""
        return StopFile(Path(place))
