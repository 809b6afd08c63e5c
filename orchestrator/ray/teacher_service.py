"""One teacher for a whole sweep: a stateless Ray actor, and its proxy in the trials.

A teacher is a pure function, so a restart of the actor or a repeated call affects no trial.
"""

from __future__ import annotations

import time
from typing import Any

import ray
from ray.exceptions import GetTimeoutError, RayActorError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from recrl.environments.cmdp import CurriculumStep
from recrl.orchestrator.errors import TeacherUnavailableError, first_line
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState

NAMESPACE = "recrl"
ANSWER_SECONDS = 30.0  # timeout of one call
PATIENCE_SECONDS = 120.0
LONGEST_PAUSE_SECONDS = 5.0


class TeacherService:
    """Actor that computes any teacher's step; each call contains the teacher's spec and state."""

    def start(self, spec: TeacherSpec) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``."""
        return make_teacher(spec).start()

    def step(
        self, spec: TeacherSpec, state: TeacherState, report: ProgressReport
    ) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        return make_teacher(spec).step(state, report)


def start_teacher_service(name: str) -> Any:
    """Start the service on this node; the driver calls this, so that no trial's placement group owns it.

    Ray would put an actor that takes no core on any node. A node without cores may lack recrl, because
    ``check_nodes`` leaves it out.

    Args:
        name: for ``find_teacher_service``, anywhere in the cluster.

    Returns:
        The actor's handle. The service lives as long as the driver holds it, and is restarted whenever it
        dies. It takes no core.
    """
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    options = {"name": name, "namespace": NAMESPACE, "num_cpus": 0, "max_restarts": -1}
    return ray.remote(TeacherService).options(**options, scheduling_strategy=here).remote()


def find_teacher_service(name: str) -> Any:
    """Return the handle of the service with a name."""
    return ray.get_actor(name, namespace=NAMESPACE)


class RayTeacher:
    """A ``Teacher`` that calls a ``TeacherService``."""

    def __init__(
        self,
        spec: TeacherSpec,
        service: Any,
        *,
        patience_seconds: float = PATIENCE_SECONDS,
    ) -> None:
        """Make a proxy, without a call yet.

        Args:
            spec: the teacher.
            service: handle of a ``TeacherService`` actor.
            patience_seconds: total time of repeated calls; longer than the loss of the service's node takes.
        """
        self._spec = spec
        self._service = service
        self._patience_seconds = patience_seconds

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``; raises TeacherUnavailableError if the service does not answer."""
        return self._ask(self._service.start, self._spec)

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``; raises TeacherUnavailableError if the service does not answer."""
        return self._ask(self._service.step, self._spec, state, report)

    def _ask(self, method: Any, *question: Any) -> tuple[CurriculumStep, TeacherState]:
        """Repeat a call until it is answered; a pure function can be called again."""
        deadline = time.monotonic() + self._patience_seconds
        pause = 0.1
        while True:
            try:
                answer: tuple[CurriculumStep, TeacherState] = ray.get(
                    method.remote(*question), timeout=ANSWER_SECONDS
                )
                return answer
            except RayTaskError as error:  # an error of the teacher itself: raised here as well
                raise error.cause from error
            except (RayActorError, GetTimeoutError) as error:
                if time.monotonic() + pause > deadline:
                    raise TeacherUnavailableError(
                        f"the teacher service has not answered for {self._patience_seconds:g} seconds "
                        f"({type(error).__name__}: {first_line(error)}); "
                        "the trial can be resumed by launching the sweep again"
                    ) from error
            time.sleep(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE_SECONDS)
