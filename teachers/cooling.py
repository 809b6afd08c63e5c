"""The cooling curriculum: a reward for being random, and a limit that is relaxed in proportion to it (ours).

An agent that settles on the first way it finds tries no other, and noise in its parameters is undone before
it leads anywhere. Here randomness is *worth* something: every nat of the policy's entropy counts as so much
reward, a temperature that falls in a straight line. While it is high the agent keeps several ways open and
the best of them gains as it falls, instead of the first. A random policy cannot keep d_d, and an agent that
is held to it all the same stays where nothing costs anything; so the limit is relaxed as far as the
temperature is high, and both arrive together.

    h = max(0, 1 - p / cooled)      heat: 1 at first, 0 from the share ``cooled`` of B on
    d = min(d_t, d_d (1 + relaxation h))
    tau = temperature h             reward per nat, in the next update

Where nothing is left to learn at a temperature, log pi(a | s) is the advantage over the temperature, up to a
constant: ``Experience.with_entropy``. It needs an agent whose price for a violation can rise until no way
through it pays (``ppo-lag`` as it is, or with a ``multiplier_maximum`` above that price; ``cpo``).

Notation: d the limit in force, d_t training limits, d_d deployment limits, B the training budget in
environment steps, p in [0, 1] the share of B that is used up, k the number of costs.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.teacher import (
    ProgressReport,
    TeacherSpec,
    TeacherState,
    already_seen,
    progress,
)


class CoolingConfig(BaseModel):
    """The settings of the cooling curriculum."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    temperature: float = Field(
        default=1.0,
        gt=0.0,
        allow_inf_nan=False,
        description="What a nat of the policy's entropy is worth at first, in the task's reward per step; "
        "about a tenth of what an episode is about.",
    )
    relaxation: float = Field(
        default=1.5,
        ge=0.0,
        allow_inf_nan=False,
        description="By what share of itself d_d is relaxed at first, d_t permitting.",
    )
    cooled: float = Field(
        default=0.7,
        gt=0.0,
        le=1.0,
        description="Share of the training budget from which entropy is worth nothing and the limit is d_d.",
    )


def heat(p: float, cooled: float) -> float:
    """h: 1 at first, then falling in a straight line, 0 from p = cooled on.

    >>> heat(0.25, 0.5)
    0.5
    """
    return max(0.0, 1.0 - p / cooled)


class CoolingTeacher:
    """The cooling curriculum, a function of the clock only.

    Its state holds ``update``, ``limits`` [k], ``policy_noise`` (always 0), ``entropy_coefficient``
    and ``start_limits`` (where the limits begin, [k]).

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
        left = heat(progress(report.env_steps, self.spec.train_steps), self.config.cooled)
        return self._taught(report.update, left, self.config.temperature * left)

    def _limits(self, left: float) -> CostLimits:
        """The limits at the heat h, [k]."""
        return CostLimits(
            tuple(
                min(train, deploy * (1.0 + self.config.relaxation * left))
                for train, deploy in zip(self.spec.train_limits, self.spec.deploy_limits, strict=True)
            )
        )

    def _taught(self, update: int, left: float, coefficient: float) -> tuple[CurriculumStep, TeacherState]:
        """The step at the heat h after an update, and the state that says so."""
        step = CurriculumStep(self._limits(left), 0.0, coefficient, self._limits(1.0))
        return step, {"update": update, **step.to_json()}
