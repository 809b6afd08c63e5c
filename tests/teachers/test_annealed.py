"""The annealed curriculum: limits and noise of a short training, by hand."""

import math
from collections.abc import Sequence

import pytest
from pydantic import ValidationError

from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase
from recrl.teachers.annealed import AnnealedConfig, annealed_noise, geometric
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import Lesson, ProgressReport, TeacherSpec

# Measured after a tenth of B, at d_d after half of it; noise held to 0.6 and gone at 0.8.
OPTIONS = {"measured_at": 0.1, "arrival": 0.5, "policy_noise": 0.4, "noise_hold": 0.6, "noise_end": 0.8}


def lessons(
    train: tuple[float, ...], deploy: tuple[float, ...], costs: Sequence[Sequence[tuple[float, ...]]]
) -> list[Lesson]:
    """What a teacher says after each tenth of B, given the costs of the episodes that finished in it."""
    teacher = make_teacher(TeacherSpec("annealed", OPTIONS, CostLimits(train), CostLimits(deploy), 100))
    lesson, state = teacher.start()
    answers = []
    for update, finished in enumerate(costs, start=1):
        episodes = tuple(
            EpisodeStats(b, Phase.TRAINING, 10 * update, 1, 0.0, cost, lesson.limits, lesson.policy_noise)
            for b, cost in enumerate(finished)
        )
        lesson, state = teacher.step(state, ProgressReport(update, 10 * update, episodes))
        answers.append(lesson)
    return answers


def test_the_limit_falls_in_equal_ratios_from_the_measured_cost_while_the_noise_is_held() -> None:
    answers = lessons((math.inf,), (1.0,), [[(10.0,), (22.0,)], *[[(50.0,)]] * 9])
    expected = [16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert [lesson.limits[0] for lesson in answers] == pytest.approx(expected)
    assert [lesson.limits[0] for lesson in answers][4:] == [1.0] * 6
    noise = [0.4, 0.4, 0.4, 0.4, 0.4, 0.4, 0.2, 0.0, 0.0, 0.0]
    assert [lesson.policy_noise for lesson in answers] == pytest.approx(noise)


def test_before_it_has_seen_an_episode_nothing_falls() -> None:
    answers = lessons((30.0,), (2.0,), [[], [], [(8.0,)], [(90.0,)], [(90.0,)]])
    assert [lesson.limits[0] for lesson in answers] == pytest.approx([30.0, 30.0, 8.0, 4.0, 2.0])


def test_the_start_lies_between_d_d_and_d_t() -> None:
    first = lessons((30.0, 30.0), (2.0, 2.0), [[(99.0, 0.5)]])[0]
    assert first.limits == CostLimits((30.0, 2.0))


def test_a_limit_of_0_is_met_by_a_step_at_the_end() -> None:
    assert geometric(0.5, 10.0, 0.0) == pytest.approx(10.0 / math.sqrt(1000.0))
    assert geometric(0.999999, 10.0, 0.0) == pytest.approx(0.01, rel=1e-4)
    assert geometric(1.0, 10.0, 0.0) == 0.0
    assert geometric(0.0, 5e-324, 0.0) == 0.0


@pytest.mark.parametrize(("start", "deploy"), [(0.0, 0.0), (3.0, 3.0), (math.inf, math.inf), (1.0, math.inf)])
def test_a_start_that_is_not_above_d_d_is_d_d(start: float, deploy: float) -> None:
    assert geometric(0.0, start, deploy) == deploy


def test_the_noise_may_end_at_once() -> None:
    config = AnnealedConfig(noise_hold=0.5, noise_end=0.5)
    assert annealed_noise(0.499, config) == config.policy_noise
    assert annealed_noise(0.5, config) == 0.0


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (
            {"measured_at": 0.5, "arrival": 0.5},
            "arrival must be above measured_at, got arrival 0.5 and measured_at 0.5",
        ),
        (
            {"noise_hold": 0.9, "noise_end": 0.8},
            "noise_end must be at least noise_hold, got noise_end 0.8 and noise_hold 0.9",
        ),
    ],
)
def test_times_out_of_order_are_named(options: dict[str, float], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        AnnealedConfig.model_validate(options)
