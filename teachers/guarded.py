"""The guarded dynamic curriculum: Algorithm 2, and a student that loses its way gets noise, too (ours).

Algorithm 2 looks at costs when it asks whether a student is stuck. A student can keep every limit and still
be lost: where the way that it knows costs 6 and the limit falls below, it mixes that way with standing still,
which costs nothing. Its mean cost then follows the limit down to d_d while its return collapses, and nothing
makes it look for the dry way. Nor does it by itself: by then it is as good as deterministic.

So this teacher remembers the best mean return of the windows that Algorithm 2 has accepted, r*. A student
whose mean return was below

    r* - return_drop max(|r*|, return_floor)

in both windows is lost: its policy gets noise, and the limits wait. If it is still lost after ``patience``
times of noise, the return is what the limits allow (J*(d) may fall with d): r* becomes the mean return of
the last window, and Algorithm 2 goes on.

Letters as in ``recrl.teachers.dynamic``.
"""

from __future__ import annotations

from typing import Any

from pydantic import Field

from recrl.environments.cmdp import CostLimits
from recrl.teachers.dynamic import DynamicConfig, DynamicTeacher
from recrl.teachers.teacher import Lesson, TeacherSpec
from recrl.teachers.windows import Stretch


class GuardedConfig(DynamicConfig):
    """The settings of the guarded dynamic curriculum: those of the dynamic one, and two more."""

    return_drop: float = Field(
        default=0.2,
        gt=0.0,
        description="Share of the best mean return (or of return_floor) that a student may lose before it "
        "counts as lost.",
    )
    patience: int = Field(
        default=5,
        ge=0,
        description="How often in a row a lost student gets noise before the loss is accepted.",
    )


def is_lost(mean_return: float, best: float, *, drop: float, floor: float) -> bool:
    """Whether a mean return has fallen: r-bar < r* - drop max(|r*|, floor).

    >>> is_lost(7.1, 9.0, drop=0.2, floor=1.0), is_lost(7.3, 9.0, drop=0.2, floor=1.0)
    (True, False)
    """
    return mean_return < best - drop * max(abs(best), floor)


class GuardedTeacher(DynamicTeacher):
    """The guarded dynamic curriculum as a function of its state.

    Its state holds besides ``best_return``, r* or None, and ``rescues``, how often in a row there was noise
    for a lost student.

    Args:
        spec: d_t, d_d, B and the options of ``GuardedConfig``.
    """

    def __init__(self, spec: TeacherSpec) -> None:
        self._guard = GuardedConfig.model_validate(dict(spec.options))
        super().__init__(spec, self._guard)

    def first_memory(self) -> dict[str, Any]:
        """No return was accepted yet."""
        return {"best_return": None, "rescues": 0}

    def reconsider(
        self, lesson: Lesson, limits: CostLimits, old: Stretch, new: Stretch, memory: dict[str, Any]
    ) -> tuple[Lesson, dict[str, Any]]:
        """Noise for a lost student, else what Algorithm 2 says."""
        if old.episodes == 0 or new.episodes == 0:
            return lesson, memory
        best, config = memory["best_return"], self._guard
        if best is not None and all(
            is_lost(window.mean_return, best, drop=config.return_drop, floor=config.return_floor)
            for window in (old, new)
        ):
            if memory["rescues"] < config.patience:
                return Lesson(limits, config.policy_noise), {**memory, "rescues": memory["rescues"] + 1}
            best = new.mean_return
        elif lesson.limits != limits:
            best = new.mean_return if best is None else max(best, new.mean_return)
        return lesson, {"best_return": best, "rescues": 0}
