"""The annealed curriculum: noise in every update, and a limit that asks for more than it allows (ours).

A student that has settled on one way of keeping its limit no longer tries others, and a kick of noise
(Algorithm 2, line 9) is unlearnt within a few updates: where the way round the river has more than a dozen
steps, ``dynamic`` hardly ever finds it. Here the policy gets noise after *every* update, so that it never
settles; the noise is taken away slowly, late in training. Meanwhile the limit falls, in equal ratios and
early, from what the noisy student costs to d_d.

Once the limit is below what so noisy a policy can keep, the student pays for every cost that it can avoid
while it goes on trying everything: stretches of river become shorter, until none is left. So the limit does
not wait for the student; those that did found the dry way less often. As the noise ends, the student
settles on the best way within d_d.

It is for ``cpo``. Its answer to a limit that cannot be kept does not grow with time, as the multipliers of
Lagrangian students do until they stand still; and its steps are measured by the KL divergence, where Adam's
are spent on the states that are visited most, and the dry way's are visited least. ``ppo-lag`` needs a low
``multiplier_maximum``, ``multiplier_waits`` and a large ``noisy_target_kl``. The latter makes ``cpo`` settle,
too, but explore less (results/rivergrid/README.md).

    d = d_t                                    until the share ``measured_at`` of B
    d = d_d (d_s / d_d)^(1 - f)                after it, d_s the mean episode cost measured there
    f = (p - p_s) / (arrival - p_s)            0 where d_s was measured, p = p_s; 1 at the share ``arrival``
    eps = policy_noise min(1, (noise_end - p) / (noise_end - noise_hold)), at least 0, after every update

Letters: d the limit in force, d_t training limits, d_d deployment limits, B the training budget in
environment steps, p in [0, 1] the share of B that is used up, k the number of costs.
"""

from __future__ import annotations

import math
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from recrl.environments.cmdp import CostLimits
from recrl.teachers.teacher import (
    Lesson,
    ProgressReport,
    TeacherSpec,
    TeacherState,
    already_seen,
    last_lesson,
    progress,
)

# Equal ratios never reach 0: a d_d below this share of the start is met by a step at the end.
SMALLEST_RATIO = 1e-3


class AnnealedConfig(BaseModel):
    """The settings of the annealed curriculum."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    measured_at: float = Field(
        default=0.07,
        gt=0.0,
        lt=1.0,
        description="Share of the training budget after which the student's mean episode cost is measured, "
        "over one update, and the limit begins to fall from it.",
    )
    arrival: float = Field(
        default=0.15,
        gt=0.0,
        le=1.0,
        description="Share of the training budget at which the limit has reached deploy_limits; above "
        "measured_at.",
    )
    policy_noise: float = Field(
        default=0.2,
        ge=0.0,
        le=1.0,
        description="eps_pi: noise added to the policy after every update until noise_hold.",
    )
    noise_hold: float = Field(
        default=0.6,
        ge=0.0,
        le=1.0,
        description="Share of the training budget from which the noise falls, in a straight line.",
    )
    noise_end: float = Field(
        default=0.85,
        ge=0.0,
        le=1.0,
        description="Share of the training budget from which there is none; at least noise_hold.",
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.arrival <= self.measured_at:
            raise ValueError(
                f"arrival must be above measured_at, got arrival {self.arrival} and "
                f"measured_at {self.measured_at}"
            )
        if self.noise_end < self.noise_hold:
            raise ValueError(
                f"noise_end must be at least noise_hold, got noise_end {self.noise_end} and "
                f"noise_hold {self.noise_hold}"
            )
        return self


def geometric(share: float, start: float, deploy_limit: float) -> float:
    """From d_s to d_d in equal ratios: d = d_d (d_s / d_d)^(1 - share).

    Args:
        share: of the way, at least 0; d_d from 1 on.
        start: d_s, at least 0; d_d if it is not above d_d.
        deploy_limit: d_d, at least 0, possibly infinite.

    >>> geometric(0.5, 16.0, 1.0)
    4.0
    """
    if share >= 1.0 or start <= deploy_limit:
        return deploy_limit
    end = max(deploy_limit, SMALLEST_RATIO * start)
    if end == 0.0:  # so small a start has no thousandth
        return deploy_limit
    limit = end * math.exp((1.0 - share) * math.log(start / end))
    return min(start, max(deploy_limit, limit))  # against rounding


def annealed_noise(p: float, config: AnnealedConfig) -> float:
    """The noise eps at the progress p: held, then falling in a straight line to 0.

    >>> annealed_noise(0.75, AnnealedConfig(policy_noise=0.5, noise_hold=0.5, noise_end=1.0))
    0.25
    """
    if p < config.noise_hold:
        return config.policy_noise
    if p >= config.noise_end:
        return 0.0
    return config.policy_noise * (config.noise_end - p) / (config.noise_end - config.noise_hold)


class AnnealedTeacher:
    """The annealed curriculum as a function of its state.

    Its state holds ``update``, ``limits`` [k], ``policy_noise``, ``start_limits`` (d_s [k], None until it is
    measured) and ``start_progress`` (p_s).

    Args:
        spec: d_t, d_d, B and the options of ``AnnealedConfig``.
    """

    def __init__(self, spec: TeacherSpec) -> None:
        self.spec = spec
        self.config = AnnealedConfig.model_validate(dict(spec.options))

    def start(self) -> tuple[Lesson, TeacherState]:
        """See ``Teacher.start``."""
        limits = self.spec.train_limits
        nowhere_to_fall = limits == self.spec.deploy_limits
        state: dict[str, Any] = {
            "update": 0,
            "limits": limits.to_json(),
            "policy_noise": 0.0,
            "start_limits": limits.to_json() if nowhere_to_fall else None,
            "start_progress": 0.0 if nowhere_to_fall else None,
        }
        return last_lesson(state), state

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[Lesson, TeacherState]:
        """See ``Teacher.step``."""
        if already_seen(state, report):
            return last_lesson(state), state
        p = progress(report.env_steps, self.spec.train_steps)
        start, start_progress = state["start_limits"], state["start_progress"]
        if start is None and p >= self.config.measured_at and report.episodes:
            start, start_progress = self._measured(report).to_json(), p
        lesson = self._lesson(p, last_lesson(state).limits, start, start_progress)
        next_state = {
            "update": report.update,
            "limits": lesson.limits.to_json(),
            "policy_noise": lesson.policy_noise,
            "start_limits": start,
            "start_progress": start_progress,
        }
        return lesson, next_state

    def _measured(self, report: ProgressReport) -> CostLimits:
        """d_s: the mean costs of an update's episodes, none below d_d or above d_t, [k]."""
        return CostLimits(
            tuple(
                min(train, max(deploy, math.fsum(costs) / len(report.episodes)))
                for train, deploy, costs in zip(
                    self.spec.train_limits,
                    self.spec.deploy_limits,
                    zip(*(episode.costs for episode in report.episodes), strict=True),
                    strict=True,
                )
            )
        )

    def _lesson(self, p: float, limits: CostLimits, start: Any, start_progress: float | None) -> Lesson:
        """What follows the limits in force at the progress p."""
        if p >= 1.0:
            return Lesson(self.spec.deploy_limits)
        noise = annealed_noise(p, self.config)
        if start is None or start_progress is None:
            return Lesson(limits, noise)
        way = self.config.arrival - start_progress
        share = (p - start_progress) / way if p < self.config.arrival else 1.0
        fallen = (
            min(limit, geometric(share, begin, deploy))
            for limit, begin, deploy in zip(
                limits, CostLimits.from_json(start), self.spec.deploy_limits, strict=True
            )
        )
        return Lesson(CostLimits(tuple(fallen)), noise)
