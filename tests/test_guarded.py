"""The guarded curriculum: noise for a student that keeps its limit and has lost its way."""

from collections.abc import Callable
from typing import Any

import pytest

from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase
from recrl.teachers.guarded import is_lost
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import Lesson, ProgressReport, TeacherSpec

UPDATES = 100
# The return and cost of an episode, from the limit in force and how often there was noise.
Student = Callable[[float, int], tuple[float, float]]


def play(student: Student, name: str = "guarded", **options: Any) -> tuple[list[float], list[int]]:
    """The limits of 100 updates from d_t = 6 to d_d = 1, and the updates after which there was noise."""
    limits = CostLimits((6.0,)), CostLimits((1.0,))
    teacher = make_teacher(TeacherSpec(name, options, *limits, train_steps=UPDATES))
    lesson, state = teacher.start()
    in_force: list[float] = []
    noisy: list[int] = []
    for update in range(1, UPDATES + 1):
        episode_return, cost = student(lesson.limits[0], len(noisy))
        finished = [
            EpisodeStats(b, Phase.TRAINING, update, 1, episode_return, (cost,), lesson.limits, 0.0)
            for b in range(4)
        ]
        lesson, state = teacher.step(state, ProgressReport(update, update, tuple(finished)))
        in_force.append(lesson.limits[0])
        noisy += [update] if lesson.policy_noise > 0.0 else []
    return in_force, noisy


def mixes(limit: float, kicks: int) -> tuple[float, float]:
    """Crosses at a cost of 6 as often as the limit lets it, else stands still for a return of -20."""
    share = min(1.0, limit / 6.0)
    return share * 9.0 - (1.0 - share) * 20.0, 6.0 * share


def test_a_return_is_lost_by_the_share_that_may_be_lost() -> None:
    assert is_lost(7.1, 9.0, drop=0.2, floor=1.0)
    assert not is_lost(7.3, 9.0, drop=0.2, floor=1.0)
    assert is_lost(-11.1, -9.0, drop=0.2, floor=1.0)
    assert is_lost(-0.3, 0.0, drop=0.2, floor=1.0)
    assert not is_lost(-0.1, 0.0, drop=0.2, floor=1.0)


def test_algorithm_2_gives_no_noise_to_a_student_that_mixes_crossing_with_standing_still() -> None:
    limits, noisy = play(mixes, "dynamic")
    assert limits[-2] == 1.0
    assert noisy == []


def test_a_student_that_noise_shows_the_dry_way_reaches_d_d_with_its_return() -> None:
    def shown_the_way(limit: float, kicks: int) -> tuple[float, float]:
        return mixes(limit, kicks) if kicks < 2 else (8.5, 0.0)

    limits, noisy = play(shown_the_way)
    assert len(noisy) == 2
    assert limits[noisy[0] - 1] == limits[noisy[1] - 1] > 1.0  # they wait while the student is lost
    assert limits[-20] == 1.0


@pytest.mark.parametrize("patience", [0, 1, 3])
def test_a_loss_that_noise_does_not_mend_is_accepted(patience: int) -> None:
    limits, noisy = play(mixes, patience=patience)
    assert limits[-1] == 1.0
    at_first = [update for update in noisy if limits[update - 1] == limits[noisy[0] - 1]] if noisy else []
    assert len(at_first) == patience


def test_a_student_that_keeps_its_return_is_taught_as_by_the_dynamic_curriculum() -> None:
    def keeps(limit: float, kicks: int) -> tuple[float, float]:
        return 9.0, limit

    assert play(keeps) == play(keeps, "dynamic")


def test_its_state_resumes() -> None:
    limits = CostLimits((6.0,)), CostLimits((1.0,))
    teacher = make_teacher(TeacherSpec("guarded", {}, *limits, train_steps=UPDATES))
    lesson, state = teacher.start()
    assert (state["best_return"], state["rescues"]) == (None, 0)
    assert lesson == Lesson(CostLimits((6.0,)))
