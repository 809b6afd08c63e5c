"""Executors run the trials of a sweep.

An executor runs specs and writes all results to the sweep's files; it returns nothing. Results are read from
the files, so an executor may die at any time. Ray is one executor (``ray.ray_executor``). ``InlineExecutor``
runs the trials one after the other in this process: for tests, debuggers and machines without Ray.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from recrl.orchestrator.errors import DamagedError
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.sweep_place import SweepPlace

logger = logging.getLogger("recrl.sweep")


class Executor(Protocol):
    """Interface of executors."""

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        """Run the specs, in order of priority, until each is finished or ``stop`` is set.

        A trial that raises is recorded as failed in its own files; the others go on. A trial whose commits
        in an object store cannot be used is left alone. When ``stop`` is set, running trials checkpoint at
        their next update and the call returns soon after.
        """
        ...


@dataclass(frozen=True)
class InlineExecutor:
    """Executor that runs the trials one after the other in this process.

    Attributes:
        on_gpu: whether they learn on CUDA.
    """

    on_gpu: bool = False

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        """See ``Executor.run``."""
        from recrl.orchestrator.trial.attempt import run_recorded  # noqa: PLC0415  (imports torch)

        for spec in specs:
            if stop.is_set():
                return
            try:
                with place.working_copy(spec, stop.is_set) as trial:
                    run_recorded(spec, trial, should_stop=stop.is_set, on_gpu=self.on_gpu)
            except DamagedError as error:
                logger.warning("%s: %s", spec.title, error)
