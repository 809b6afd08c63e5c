"""A worker process of Ray Tune, which runs one trial after the other.

A trial's result depends only on its spec, and importing torch takes as long as a small trial, so processes
are reused.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ray
from ray import tune

from recrl.orchestrator.errors import DamagedError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.ray.sigterm import noticing_sigterm
from recrl.orchestrator.ray.teacher_service import RayTeacher, find_teacher_service
from recrl.orchestrator.remote.remote_sweep import sweep_place
from recrl.orchestrator.spec import TrialSpec

logger = logging.getLogger("recrl.sweep")


class TuneTrial(tune.Trainable):
    """Tune's interface to a worker process; each of its trials is one long step.

    A trial reports to Tune only at its end, because a report blocks until the driver has received it.
    Progress is in the files.
    """

    def setup(self, config: dict[str, Any]) -> None:
        """Prepare for the first trial."""
        self._take(config)

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        """Prepare for the next trial in the same process."""
        self._take(new_config)
        return True

    def step(self) -> dict[str, Any]:
        """Run the trial to its end or until the sweep is stopped.

        Raises:
            TeacherUnavailableError: the teacher does not answer; Tune tries the trial again.
            StorageError: the object store was down for too long; Tune tries the trial again.
            SystemExit: the process got SIGTERM; the trial waits, and Tune tries it again.
        """
        from recrl.orchestrator.trial.attempt import run_recorded  # noqa: PLC0415  (imports torch; the driver does without)

        if self._stop_signal.is_set():
            return {"done": True}
        with noticing_sigterm() as got_sigterm:

            def should_stop() -> bool:
                return got_sigterm() or self._stop_signal.is_set()

            try:
                with self._place.working_copy(self._spec, should_stop) as trial:
                    run_recorded(
                        self._spec,
                        trial,
                        should_stop=should_stop,
                        is_interrupted=got_sigterm,
                        teacher=self._teacher,
                        commit_seconds=self._commit_seconds,
                        on_gpu=bool(ray.get_gpu_ids()),
                    )
            except DamagedError as error:  # no reason to try again; the driver's copy has the status damaged
                logger.warning("%s: %s", self._spec.title, error)
        return {"done": True}

    def _take(self, config: Mapping[str, Any]) -> None:
        self._spec = TrialSpec.from_json(json.loads(config["spec"]))
        sweep = Path(config["sweep"])
        self._place = sweep_place(SweepStore(sweep.parent, sweep.name), config["storage"])
        self._stop_signal = self._place.stop_signal_at(config["stop_signal"])
        self._commit_seconds: float = config["commit_seconds"]
        name = config["teacher_service"]
        self._teacher = RayTeacher(self._spec.teacher, find_teacher_service(name)) if name else None


def spec_of(trial: Any) -> TrialSpec:
    """Return the recrl trial of a Tune trial."""
    return TrialSpec.from_json(json.loads(trial.config["spec"]))
