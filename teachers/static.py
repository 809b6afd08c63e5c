"""Static curricula: the cost limit is a fixed function of the training's progress (Algorithm 1).

The three decays of the paper, and the controls with a constant limit during training. The clock counts
environment steps (``teacher.progress``) and is read once per policy update.

Notation: d_t training limits, d_d deployment limits, B the training budget in environment steps,
p = env steps / B in [0, 1] the progress, k the number of costs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from pydantic import Field

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.options import Options
from recrl.teachers.start_limits import START_FRACTION, StartMeasurement
from recrl.teachers.teacher import (
    ProgressReport,
    TeacherSpec,
    TeacherState,
    already_seen,
    progress,
)

# A decay maps (p, d_t, d_d) to the limit d of one dimension; d_t and d_d finite, d_t >= d_d.
Decay = Callable[[float, float, float], float]


def linear(p: float, train_limit: float, deploy_limit: float) -> float:
    """Linear decay, Algorithm 1, line 8: d = p d_d + (1 - p) d_t.

    >>> linear(0.25, 100.0, 20.0)
    80.0
    """
    return p * deploy_limit + (1.0 - p) * train_limit


def cosine(p: float, train_limit: float, deploy_limit: float) -> float:
    """Cosine decay, Algorithm 1, line 10: d = cos(pi p / 2) d_t + (1 - cos(pi p / 2)) d_d.

    >>> round(cosine(2 / 3, 100.0, 20.0), 12)
    60.0
    """
    return math.cos(math.pi * p / 2) * train_limit + (1.0 - math.cos(math.pi * p / 2)) * deploy_limit


def exponential(p: float, train_limit: float, deploy_limit: float) -> float:
    """Exponential decay, Algorithm 1, line 6: d = ((d_t - d_d) e^-p + d_d - d_t / e) / (1 - 1 / e).

    >>> round(exponential(-math.log((1 + math.exp(-1)) / 2), 100.0, 20.0), 12)
    60.0
    """
    return ((train_limit - deploy_limit) * math.exp(-p) + deploy_limit - math.exp(-1) * train_limit) / (
        1.0 - math.exp(-1)
    )


def constant(p: float, train_limit: float, deploy_limit: float) -> float:
    """No decay: d = d_t."""
    return train_limit


def limit_at(p: float, train_limit: float, deploy_limit: float, decay: Decay) -> float:
    """Return the limit of one dimension at progress p; d_t may be infinite.

    It is d_d from p = 1 on, and infinite before if d_t is. Else it is the decay, whose rounding beyond d_t or
    d_d is corrected.

    Raises:
        TypeError: the decay is text.
        ValueError: the decay is not within d_d and d_t.
    """
    if p >= 1.0 or train_limit == deploy_limit:
        return deploy_limit
    if math.isinf(train_limit):
        return math.inf
    limit = decay(p, train_limit, deploy_limit)
    if isinstance(limit, str):
        raise TypeError(f"the decay must return a number, got {limit!r} at progress {p:g}")
    within = min(max(limit, deploy_limit), train_limit)
    if not math.isclose(limit, within, rel_tol=1e-9, abs_tol=1e-9):
        raise ValueError(
            f"the decay must be between d_d = {deploy_limit:g} and d_t = {train_limit:g}, got {limit:g} at "
            f"progress {p:g}"
        )
    return within


class StaticTeacher:
    """A curriculum that depends on the clock only.

    Its state holds ``update``, ``limits`` [k], ``policy_noise`` (always 0) and the keys of
    ``StartMeasurement``.

    Args:
        spec: d_t, d_d and B.
        decay: the limit as a function of progress; for a decay with options, ``functools.partial`` of it.
        start_fraction: fraction of B for measuring an infinite d_t, as with ``train_limits: auto``; 0 to keep
            it infinite until B.
    """

    def __init__(self, spec: TeacherSpec, *, decay: Decay, start_fraction: float = START_FRACTION) -> None:
        self.spec = spec
        self.decay = decay
        self.measurement = StartMeasurement(spec, start_fraction)

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``."""
        state = {
            "update": 0,
            "limits": self.spec.train_limits.to_json(),
            "policy_noise": 0.0,
            **self.measurement.begin(),
        }
        return CurriculumStep.from_json(state), state

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        if already_seen(state, report):
            return CurriculumStep.from_json(state), state
        start = self.measurement.advance(state, report)
        p = progress(report.env_steps, self.spec.train_steps)
        limits = CostLimits(
            tuple(
                _fallen(limit, limit_at(p, train, deploy, self.decay))
                for limit, train, deploy in zip(
                    CostLimits.from_json(state["limits"]),
                    self.measurement.limits(start),
                    self.spec.deploy_limits,
                    strict=True,
                )
            )
        )
        next_state = {"update": report.update, "limits": limits.to_json(), "policy_noise": 0.0, **start}
        return CurriculumStep.from_json(next_state), next_state


def _fallen(before: float, after: float) -> float:
    """Return the next limit: the limit before it, if it has risen by rounding only."""
    return min(before, after) if math.isclose(before, after, rel_tol=1e-9, abs_tol=1e-9) else after


class NoConfig(Options):
    """Settings of a curriculum without options."""


class DecayConfig(Options):
    """Settings of a decaying curriculum."""

    start_fraction: float = Field(
        default=START_FRACTION,
        gt=0.0,
        le=0.5,
        description="Fraction of the training steps without limits for measuring the start of the "
        "decay, if train_limits is infinite (section 5.1 of the paper: 'a few "
        "episodes').",
    )


def decay_teacher(spec: TeacherSpec, *, decay: Decay) -> StaticTeacher:
    """CLiC_L, CLiC_C or CLiC_E, from d_t, or from the measured costs if d_t is infinite."""
    config = DecayConfig.model_validate(dict(spec.options))
    return StaticTeacher(spec, decay=decay, start_fraction=config.start_fraction)


def none_teacher(spec: TeacherSpec) -> StaticTeacher:
    """No curriculum: d_d from the start."""
    return StaticTeacher(replace(spec, train_limits=spec.deploy_limits), decay=constant, start_fraction=0.0)


def step_teacher(spec: TeacherSpec) -> StaticTeacher:
    """A control: d_t until B, then d_d at once."""
    return StaticTeacher(spec, decay=constant, start_fraction=0.0)


def unconstrained_teacher(spec: TeacherSpec) -> StaticTeacher:
    """A control: no limit until B, for any d_t, then d_d at once.

    It is ``step`` with d_t = infinity, which turns the training model into an MDP (paper, section 4). It
    shows return and cost of the unconstrained agent.
    """
    unlimited = CostLimits.unlimited(len(spec.train_limits))
    return StaticTeacher(replace(spec, train_limits=unlimited), decay=constant, start_fraction=0.0)
