"""Storage of a sweep: its folder, or an object store of which the folder is a copy.

A launch, its executors and the commands use a ``SweepPlace`` for both. That of an object store is
``remote.remote_sweep.RemoteSweep``; ``remote.opening`` chooses.
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
    """Stop signal of one run of a sweep for its workers on all nodes."""

    @property
    def place(self) -> str:
        """Name of the signal for workers: see ``SweepPlace.stop_sign_at``."""
        ...

    @property
    def uri(self) -> str:
        """The address of the sweep in an object store, or empty."""
        ...

    def set(self) -> None:
        """Signal the workers to stop."""
        ...

    def is_set(self) -> bool:
        """Return whether to stop; may be called often."""
        ...


class SweepPlace(Protocol):
    """Storage of the trials of a sweep, as seen from one machine."""

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
        """Check that the place can be used, before any work.

        Raises:
            RecrlError: it cannot.
        """
        ...

    def require_reruns(self) -> None:
        """Check that finished trials can be run again here.

        Raises:
            RecrlError: they cannot.
        """
        ...

    def held(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Hold the sweep as the only launch on all machines; its folder is locked already.

        Args:
            stop: set on a request from another machine, or when another launch has taken over.

        Raises:
            SweepBusyError: another launch runs the sweep.
        """
        ...

    def pull(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date.

        Args:
            checkpoints: whether to include those of running trials.
        """
        ...

    def refresh(self, *, checkpoints: bool = False) -> None:
        """Bring the folder up to date for a reader; log a warning if that is impossible."""
        ...

    def publish(self) -> None:
        """Send the sweep's own files."""
        ...

    def kept_up_to_date(self, stop: threading.Event) -> AbstractContextManager[None]:
        """Keep the folder up to date while the body runs, and once more after it."""
        ...

    def settle(self, specs: Sequence[TrialSpec]) -> None:
        """Send the status of trials whose processes died, which only this machine knows."""
        ...

    def request_stop(self) -> Callable[[], bool]:
        """Ask the launch that runs the sweep, on any machine, to save its trials and end.

        Returns:
            A function that returns whether it still runs.
        """
        ...

    def pull_trial(self, spec: TrialSpec) -> None:
        """Bring one trial in the folder up to date."""
        ...

    def is_out_of_touch(self, silence_seconds: float) -> bool:
        """Return whether the folder is too old to conclude from a silence of this many seconds."""
        ...

    def working_copy(
        self, spec: TrialSpec, should_stop: Callable[[], bool]
    ) -> AbstractContextManager[TrialStore]:
        """Return a folder for one attempt at a trial, on the machine that runs it."""
        ...

    def new_stop_sign(self) -> AbstractContextManager[StopSign]:
        """Return the stop signal of a new run; workers of earlier runs are stopped."""
        ...

    def stop_sign_at(self, place: str) -> StopSign:
        """Return the stop signal of a run by its ``StopSign.place``."""
        ...


@dataclass(frozen=True)
class LocalSweep:
    """A sweep in its folder; every node sees the folder under the same path.

    Attributes:
        store: the folder.
    """

    store: SweepStore
    uri = ""
    address = ""

    def prepare(self) -> None:
        """See ``SweepPlace``; does nothing, like the other methods without a body."""

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
