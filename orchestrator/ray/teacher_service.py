"""One teacher for a whole sweep: a Ray actor that keeps nothing, and the proxy through which trials ask it.

A teacher is a pure function, so the actor may be killed and restarted, and a question may be asked twice,
without a trace in any trial. Kept out of ``ray_executor`` because workers import this and not Tune.
"""

from __future__ import annotations

import time
from typing import Any

import ray
from ray.exceptions import GetTimeoutError, RayActorError, RayTaskError

from recrl.environments.cmdp import CurriculumStep
from recrl.orchestrator.errors import TeacherUnavailableError
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState

NAMESPACE = "recrl"
ANSWER_SECONDS = 30.0
PATIENCE_SECONDS = 120.0
LONGEST_PAUSE_SECONDS = 5.0


class TeacherService:
    """Answers for any teacher; which one, and where its trial stands, comes with every question."""

    def start(self, spec: TeacherSpec) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``."""
        return make_teacher(spec).start()

    def step(
        self, spec: TeacherSpec, state: TeacherState, report: ProgressReport
    ) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        return make_teacher(spec).step(state, report)


def start_teacher_service(name: str) -> Any:
    """Start the service; to be called by the driver, so that no trial's placement group owns it.

    Args:
        name: under which ``find_teacher_service`` finds it, anywhere in the cluster.

    Returns:
        The actor's handle; the service lives as long as the driver holds it, and is restarted as often as
        it dies. It takes no core.
    """
    options = {"name": name, "namespace": NAMESPACE, "num_cpus": 0, "max_restarts": -1}
    return ray.remote(TeacherService).options(**options).remote()


def find_teacher_service(name: str) -> Any:
    """The handle of the service that was started under a name."""
    return ray.get_actor(name, namespace=NAMESPACE)


class RayTeacher:
    """A ``Teacher`` whose thinking is done by a ``TeacherService``."""

    def __init__(
        self,
        spec: TeacherSpec,
        service: Any,
        *,
        answer_seconds: float = ANSWER_SECONDS,
        patience_seconds: float = PATIENCE_SECONDS,
    ) -> None:
        """Make a proxy; asks nothing yet.

        Args:
            spec: the teacher.
            service: handle of a ``TeacherService`` actor.
            answer_seconds: how long one answer may take.
            patience_seconds: how long to go on asking; more than losing the service's node takes.
        """
        self._spec = spec
        self._service = service
        self._answer_seconds = answer_seconds
        self._patience_seconds = patience_seconds

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``; raises TeacherUnavailableError if the service stays away."""
        return self._ask(self._service.start, self._spec)

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``; raises TeacherUnavailableError if the service stays away."""
        return self._ask(self._service.step, self._spec, state, report)

    def _ask(self, method: Any, *question: Any) -> tuple[CurriculumStep, TeacherState]:
        """Ask until there is an answer: a pure function may be asked again."""
        deadline = time.monotonic() + self._patience_seconds
        pause = 0.1
        while True:
            try:
                answer: tuple[CurriculumStep, TeacherState] = ray.get(
                    method.remote(*question), timeout=self._answer_seconds
                )
                return answer
            except RayTaskError as error:  # the teacher raised: as if it had done so here
                raise error.cause from error
            except (RayActorError, GetTimeoutError) as error:
                if time.monotonic() + pause > deadline:
                    raise TeacherUnavailableError(
                        f"the teacher service has not answered for {self._patience_seconds:g} seconds "
                        f"({type(error).__name__}); the trial can be resumed by launching the sweep again"
                    ) from error
            time.sleep(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE_SECONDS)
