"""The cooling curriculum: limits and temperatures of a short training, by hand."""

import math

import pytest
from pydantic import ValidationError

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.cooling import CoolingConfig
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec

OPTIONS = {"temperature": 2.0, "relaxation": 1.5, "cooled": 0.5}


def lessons(train: tuple[float, ...], deploy: tuple[float, ...]) -> list[CurriculumStep]:
    """What a teacher says at first and after each tenth of B."""
    teacher = make_teacher(TeacherSpec("cooling", OPTIONS, CostLimits(train), CostLimits(deploy), 100))
    step, state = teacher.start()
    answers = [step]
    for update in range(1, 11):
        step, state = teacher.step(state, ProgressReport(update, 10 * update, ()))
        answers.append(step)
    return answers


def test_limit_and_temperature_fall_together_in_a_straight_line() -> None:
    answers = lessons((math.inf,), (4.0,))
    assert [step.limits[0] for step in answers] == pytest.approx([10, 8.8, 7.6, 6.4, 5.2, *[4.0] * 6])
    assert [step.entropy_coefficient for step in answers] == pytest.approx(
        [0, 1.6, 1.2, 0.8, 0.4, *[0.0] * 6]
    )
    assert [step.limits[0] for step in answers][5:] == [4.0] * 6
    assert all(step.policy_noise == 0.0 for step in answers)


def test_the_limit_is_relaxed_as_far_as_d_t_permits_and_a_limit_of_0_not_at_all() -> None:
    answers = lessons((7.0, 5.0), (4.0, 0.0))
    assert [step.limits[0] for step in answers] == pytest.approx([7, 7, 7, 6.4, 5.2, *[4.0] * 6])
    assert {step.limits[1] for step in answers} == {0.0}


@pytest.mark.parametrize(
    "options", [{"temperature": 0.0}, {"relaxation": -0.1}, {"cooled": 0.0}, {"temperature": math.inf}]
)
def test_options_out_of_range_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        CoolingConfig.model_validate(options)


@pytest.mark.parametrize("coefficient", [-0.1, math.inf, math.nan])
def test_an_entropy_coefficient_is_finite_and_not_negative(coefficient: float) -> None:
    with pytest.raises(ValueError, match="entropy coefficient must be finite and at least 0"):
        CurriculumStep(CostLimits((1.0,)), entropy_coefficient=coefficient)
