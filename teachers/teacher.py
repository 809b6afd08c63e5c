"""Interface between a trial and its curriculum.

A teacher is a pure function ``step(state, report) -> (CurriculumStep, state')``. The *trial* holds the state,
which is opaque to it, and checkpoints it with the agent. A teacher keeps nothing between calls. So it can run
inline, in an actor of its own or in one actor for a whole sweep, and always gives the same limits. It is
called once per policy update, with every episode that finished since the last call.

Notation: d_t training limits, d_d deployment limits, B the training budget in environment steps, p = env
steps / B in [0, 1] the progress, k the number of costs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats

# State of a teacher: JSON values only, so that it can be checkpointed and sent between processes.
TeacherState = Mapping[str, Any]


@dataclass(frozen=True)
class ProgressReport:
    """Report of a trial to its teacher after a policy update.

    Attributes:
        update: index of the last policy update, counted from 1.
        env_steps: environment steps taken so far, over all the trial's environments.
        episodes: the episodes that finished since the last report, in order; may be empty.
    """

    update: int
    env_steps: int
    episodes: tuple[EpisodeStats, ...]


@dataclass(frozen=True)
class TeacherSpec:
    """Specification of a teacher; it can be sent between processes.

    Attributes:
        name: registry name (``none``, ``linear``, ``dynamic``, ...), entry point or import path.
        options: the teacher's settings, which its config class validates.
        train_limits: d_t, [k], possibly infinite.
        deploy_limits: d_d, [k], finite, each at most d_t.
        train_steps: B, environment steps of the training phase, at least 1.
    """

    name: str
    options: Mapping[str, Any]
    train_limits: CostLimits
    deploy_limits: CostLimits
    train_steps: int

    def __post_init__(self) -> None:
        for name in ("train_limits", "deploy_limits"):
            if not isinstance(given := getattr(self, name), CostLimits):  # plain numbers
                object.__setattr__(self, name, CostLimits(given))
        if len(self.train_limits) != len(self.deploy_limits):
            raise ValueError(
                f"train_limits and deploy_limits must have one entry per cost, "
                f"got {len(self.train_limits)} and {len(self.deploy_limits)}"
            )
        for train, deploy in zip(self.train_limits, self.deploy_limits, strict=True):
            if math.isinf(deploy):
                raise ValueError(f"deploy_limits must be finite, got {self.deploy_limits.to_json()}")
            if train < deploy:
                raise ValueError(
                    f"train_limits must be at least deploy_limits (d_t >= d_d), got {train} < {deploy}"
                )
        if self.train_steps < 1:
            raise ValueError(f"train_steps must be at least 1, got {self.train_steps}")


class Teacher(Protocol):
    """A cost-limit curriculum (the paper's CLiC teacher)."""

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """Return the step of the first update and the state before any update."""
        ...

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """Return the step of the next update, given the finished episodes; ``state`` is not changed.

        Idempotent in the update index: a repeated report of the update in ``state`` returns the same step and
        state.

        Raises:
            ValueError: ``report.update`` is neither the update of the state nor the next one.
        """
        ...


@dataclass(frozen=True)
class AnswerCheck:
    """Check of what a curriculum, possibly of a user's code, returns.

    Attributes:
        curriculum: its label, for errors.
        cost_names: of the task, [k].
        train_limits: d_t, [k].
        deploy_limits: d_d, [k].
    """

    curriculum: str
    cost_names: Sequence[str]
    train_limits: CostLimits
    deploy_limits: CostLimits

    def checked(
        self, answer: object, *, before: CostLimits | None = None, update: int = 0
    ) -> tuple[CurriculumStep, TeacherState]:
        """Check and return the result of ``Teacher.start`` or ``Teacher.step``.

        No limit may have risen, and each must be at least d_d, and at most d_t if finite. An infinite limit
        may start above a finite d_t: it constrains nothing, as in the control ``unconstrained``. Differences
        by rounding are allowed.

        Args:
            answer: the result.
            before: the limits before it, [k]; None at the start.
            update: the last policy update before it; 0 at the start.

        Raises:
            TypeError: it is not a pair of a CurriculumStep and a mapping, or the mapping has other values
                than JSON.
            ValueError: the number of its limits, or start limits, is not that of the costs; or a limit has
                risen, or is above d_t or below d_d.
        """
        match answer:
            case (CurriculumStep() as step, Mapping() as state):
                if problem := _not_json(dict(state), "state"):
                    raise TypeError(
                        f"curriculum {self.curriculum}: {problem}; a state holds JSON values only"
                    )
                self._check_limits(step, before, f"after update {update}" if update else "at the start")
                return step, state
        got = (
            ", ".join(type(one).__name__ for one in answer)
            if isinstance(answer, tuple)
            else type(answer).__name__
        )
        raise TypeError(
            f"curriculum {self.curriculum}: must return a CurriculumStep and its state, a mapping, got {got}"
        )

    def _check_limits(self, step: CurriculumStep, before: CostLimits | None, when: str) -> None:
        of_whom, num_costs = f"curriculum {self.curriculum}", len(self.cost_names)
        if len(step.limits) != num_costs:
            raise ValueError(
                f"{of_whom}: a step must have one limit per cost, {num_costs}, got {len(step.limits)}"
            )
        if step.start_limits is not None and len(step.start_limits) != num_costs:
            raise ValueError(
                f"{of_whom}: start_limits must be None or one limit per cost, {num_costs}, "
                f"got {len(step.start_limits)}"
            )
        for i, (name, limit) in enumerate(zip(self.cost_names, step.limits, strict=True)):
            if before is not None and _exceeds(limit, before[i]):
                raise ValueError(
                    f"{of_whom}: the limit of {name} rose from {before[i]:g} to {limit:g} {when}; "
                    "limits may only fall"
                )
            if math.isfinite(limit) and _exceeds(limit, self.train_limits[i]):
                raise ValueError(
                    f"{of_whom}: the limit of {name} is {limit:g} {when}, above its train_limits "
                    f"of {self.train_limits[i]:g}; limits may only fall"
                )
            if _exceeds(self.deploy_limits[i], limit):
                raise ValueError(
                    f"{of_whom}: the limit of {name} is {limit:g} {when}, below its deploy_limits "
                    f"of {self.deploy_limits[i]:g}; limits may only fall to that"
                )


def _exceeds(limit: float, other: float) -> bool:
    return limit > other and not math.isclose(limit, other, rel_tol=1e-9, abs_tol=1e-9)


def _not_json(value: object, path: str) -> str:
    """Describe the first part of a state that is no JSON value; empty if there is none.

    Tuples are not allowed: a checkpoint gives back a list. Infinite numbers are, because checkpoints keep
    them.

    >>> _not_json({"update": 1, "seen": {3}}, "state")
    "state['seen'] is a set"
    """
    if value is None or isinstance(value, bool | int | float | str):
        return ""
    if isinstance(value, list):
        parts = ((f"{path}[{index}]", part) for index, part in enumerate(value))
    elif isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                return f"{path} has the key {key!r}, {_with_article(key)}, and keys must be text"
        parts = ((f"{path}[{key!r}]", part) for key, part in value.items())
    else:
        return f"{path} is {_with_article(value)}"
    return next((problem for name, part in parts if (problem := _not_json(part, name))), "")


def _with_article(value: object) -> str:
    kind = type(value).__name__
    return f"an {kind}" if kind[0].lower() in "aeiou" or kind == "ndarray" else f"a {kind}"


# The rest is common to the teachers of this package. Their states hold at least ``update``, the last update
# seen (0 before the first), and the keys of ``CurriculumStep.to_json``. So a repeated report is answered from
# the state alone.


def progress(env_steps: int, train_steps: int) -> float:
    """Return the used fraction of the training budget: p = env steps / B, at most 1.

    Algorithm 1, line 3, has p = b / B in episodes. Episodes differ in length, and a run's length is set in
    steps, so the clock counts steps: p = 1 exactly when deployment begins.
    """
    return min(1.0, env_steps / train_steps)


def already_seen(state: TeacherState, report: ProgressReport) -> bool:
    """Whether ``state`` includes this report already (False: the report is the next one).

    Raises:
        ValueError: the report is for any other update.
    """
    seen = int(state["update"])
    if report.update not in (seen, seen + 1):
        raise ValueError(
            f"this teacher state has seen update {seen}: the next report must be for update {seen + 1}, "
            f"or for {seen} again, got {report.update}"
        )
    return report.update == seen
