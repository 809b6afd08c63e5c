"""Who runs the trials of a sweep.

An executor works through specs and leaves everything it achieved in the sweep's files; it returns nothing.
What happened is read back from there, so an executor may die at any time. Ray is one executor
(``ray.executor``); ``InlineExecutor`` runs the trials one after the other in this process: for tests,
debuggers, and machines without Ray.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Protocol

from recrl.orchestrator.places import SweepPlace
from recrl.orchestrator.spec import TrialSpec


class Executor(Protocol):
    """Something that runs trials."""

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        """Work on the specs, in order of priority, until each is finished or ``stop`` is set.

        A trial that raises is recorded as failed in its own files; the others go on. When ``stop`` is
        set, running trials checkpoint at their next update and the call returns soon after.
        """
        ...


class InlineExecutor:
    """Runs the trials one after the other in this process."""

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        """See ``Executor.run``."""
        from recrl.orchestrator.trial.runner import run_recorded  # noqa: PLC0415  (imports torch)

        for spec in specs:
            if stop.is_set():
                return
            with place.working_copy(spec, stop.is_set) as trial:
                run_recorded(spec, trial, should_stop=stop.is_set)
