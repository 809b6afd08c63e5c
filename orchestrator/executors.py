"""The seam between a sweep and whatever runs its trials.

An executor works through specs and leaves everything it achieved in the store's files; it returns nothing.
What happened is read back from there, so an executor may die at any time. Ray is one executor, in
``ray_executor``; ``InlineExecutor`` runs the trials one after the other in this process: for tests,
debuggers, and machines without Ray.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from recrl.orchestrator.files.store import SweepStore
from recrl.orchestrator.spec import TrialSpec

if TYPE_CHECKING:
    from recrl.orchestrator.remote.remote_sweep import RemoteSweep


class Executor(Protocol):
    """Something that runs trials."""

    def run(self, specs: Sequence[TrialSpec], store: SweepStore, stop: threading.Event) -> None:
        """Work on the specs, in order of priority, until each is finished or ``stop`` is set.

        A trial that raises is recorded as failed in its own files; the others go on. When ``stop`` is
        set, running trials checkpoint at their next update and the call returns soon after.
        """
        ...


@dataclass(frozen=True)
class InlineExecutor:
    """Runs the trials one after the other in this process.

    Attributes:
        storage: where the trials are kept; None for the sweep's folder itself.
    """

    storage: RemoteSweep | None = None

    def run(self, specs: Sequence[TrialSpec], store: SweepStore, stop: threading.Event) -> None:
        """See ``Executor.run``."""
        from recrl.orchestrator.trial.trial import run_recorded  # noqa: PLC0415  (imports torch)

        for spec in specs:
            if stop.is_set():
                return
            place = (
                self.storage.working_copy(spec, stop.is_set)
                if self.storage
                else nullcontext(store.trial(spec))
            )
            with place as trial:
                run_recorded(spec, trial, should_stop=stop.is_set)
