"""The cooling curriculum: an annealed entropy reward, and a limit that is relaxed in proportion to it (ours).

An agent that converges to the first solution it finds tries no other, and parameter noise is undone before it
has an effect. Here the policy's *entropy* is rewarded, with a coefficient that decreases linearly. While the
coefficient is large, the agent keeps several solutions, and the best of them gains as it decreases. A random
policy cannot keep d_d: under that limit an agent would only avoid all cost. So the limit is relaxed in
proportion to the coefficient, and both reach their final values together.

    h = max(0, 1 - p / cooled)      annealing factor: 1 at first, 0 from the fraction ``cooled`` of B on
    d = min(d_t, d_d (1 + relaxation h))
    tau = temperature h             reward per nat, in the next update; 0 in the first one

If learning has converged at a coefficient tau, log pi(a | s) is the advantage over tau, up to a constant; see
``Experience.with_entropy``. The agent's multiplier must be able to grow until no violation pays. ``ppo-lag``
(with a sufficient ``multiplier_maximum``) and ``cpo`` have this property. The actions must be discrete: the
entropy of a Gaussian policy has no bound.

Notation: d the limit in force, d_t training limits, d_d deployment limits, B the training budget in
environment steps, p in [0, 1] the used fraction of B, k the number of costs.
"""

from __future__ import annotations

from pydantic import Field

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.options import Options
from recrl.teachers.teacher import (
    ProgressReport,
    TeacherSpec,
    TeacherState,
    already_seen,
    progress,
)


class CoolingConfig(Options):
    """The settings of the cooling curriculum."""

    temperature: float = Field(
        default=1.0,
        gt=0.0,
        allow_inf_nan=False,
        description="Initial entropy coefficient: reward per nat and step, in the task's unit; "
        "about a tenth of the differences in return of an episode.",
    )
    relaxation: float = Field(
        default=1.5,
        ge=0.0,
        allow_inf_nan=False,
        description="Initial relaxation of the limit, as a fraction of d_d; the limit is at most d_t.",
    )
    cooled: float = Field(
        default=0.7,
        gt=0.0,
        le=1.0,
        description="Fraction of the training budget after which the entropy coefficient is 0 and "
        "the limit is d_d.",
    )


def annealing_factor(p: float, cooled: float) -> float:
    """Return h: 1 at first, linearly decreasing, 0 from p = ``cooled`` on.

    >>> annealing_factor(0.25, 0.5)
    0.5
    """
    return max(0.0, 1.0 - p / cooled)


class CoolingTeacher:
    """The cooling curriculum, a function of the clock only.

    Its state holds ``update``, ``limits`` [k], ``policy_noise`` (always 0), ``entropy_coefficient``
    and ``start_limits`` (the initial limits, [k]).

    Args:
        spec: d_t, d_d, B and the options of ``CoolingConfig``.
    """

    def __init__(self, spec: TeacherSpec) -> None:
        self.spec = spec
        self.config = CoolingConfig.model_validate(dict(spec.options))

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``."""
        return self._taught(0, 1.0, 0.0)

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        if already_seen(state, report):
            return CurriculumStep.from_json(state), state
        factor = annealing_factor(progress(report.env_steps, self.spec.train_steps), self.config.cooled)
        return self._taught(report.update, factor, self.config.temperature * factor)

    def _limits(self, factor: float) -> CostLimits:
        """Return the limits at the annealing factor h, [k]."""
        return CostLimits(
            tuple(
                min(train, deploy * (1.0 + self.config.relaxation * factor))
                for train, deploy in zip(self.spec.train_limits, self.spec.deploy_limits, strict=True)
            )
        )

    def _taught(self, update: int, factor: float, coefficient: float) -> tuple[CurriculumStep, TeacherState]:
        """Return the step at the annealing factor h after an update, and its state."""
        step = CurriculumStep(self._limits(factor), 0.0, coefficient, self._limits(1.0))
        return step, {"update": update, **step.to_json()}
