"""Storage of a sweep: its folder, or an object store of which the folder is a copy.

A launch, its executors and the commands use a ``SweepPlace`` for both. That of an object store is
``remote.remote_sweep.RemoteSweep``; ``sweep_place`` there chooses.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from recrl.orchestrator.files.stop_file import StopFile, StopSignal
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec


class SweepPlace:
    """Storage of the trials of a sweep, as seen from one machine; here the sweep's folder.

    Every node sees the folder under the same path, so most methods have nothing to do.

    Attributes:
        store: the sweep's folder on this machine: the sweep itself, or a copy.
        uri: the address of all sweeps in the object store, or empty.
    """

    uri = ""
    shortest_silence_seconds = 0.0  # heartbeats arrive this late through an object store

    def __init__(self, store: SweepStore) -> None:
        self.store = store

    @property
    def address(self) -> str:
        """The address of this sweep in the object store, or empty."""
        return ""

    def prepare(self) -> None:
        """Check that the place can be used, before any work.

        Raises:
            RecrlError: it cannot.
        """

    def require_reruns(self) -> None:
        """Check that finished trials can be run again here.

        Raises:
            RecrlError: they cannot.
        """

    def held(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Hold the sweep as the only launch on all machines; its folder is locked already.

        Args:
            stop: set on a request from another machine, or when another launch has taken over.

        Raises:
            SweepBusyError: another launch runs the sweep.
        """
        return nullcontext()

    def pull(self) -> None:
        """Bring the folder up to date."""

    def refresh(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date for a reader; log a warning if that is impossible.

        Args:
            checkpoints: whether to include those of running trials.
        """

    def publish(self) -> None:
        """Send the sweep's own files."""

    def kept_up_to_date(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Keep the folder up to date while the body runs, and once more after it."""
        return nullcontext()

    def send_dead_trials(self, specs: Sequence[TrialSpec]) -> None:
        """Send the status of trials whose processes died, which only this machine knows."""

    def request_stop(self) -> Callable[[], bool]:
        """Ask the launch that runs the sweep, on any machine, to save its trials and end.

        Returns:
            A function that returns whether it still runs.
        """
        if self.store.is_locked():
            self.store.stop_request_path.touch()
        return self.store.is_locked

    def pull_trial(self, spec: TrialSpec) -> None:
        """Bring one trial in the folder up to date."""

    def is_out_of_touch(self, silence_seconds: float) -> bool:
        """Return whether the folder is too old to conclude from a silence of this many seconds."""
        return False

    def working_copy(
        self, spec: TrialSpec, should_stop: Callable[[], bool]
    ) -> AbstractContextManager[TrialStore]:
        """Return a folder for one attempt at a trial, on the machine that runs it."""
        return nullcontext(self.store.trial(spec))

    def new_stop_signal(self) -> AbstractContextManager[StopSignal]:
        """Return the stop signal of a new run; workers of earlier runs are stopped."""
        return StopFile.open(self.store.folder)

    def stop_signal_at(self, place: str) -> StopSignal:
        """Return the stop signal that a run has made: its ``StopSignal.place``."""
        return StopFile(Path(place))
