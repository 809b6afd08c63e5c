"""Algorithm 1: the three decays by hand, the clock, and where a curriculum starts."""

import math
from collections.abc import Sequence

import pytest

from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase
from recrl.teachers.registry import make_teacher
from recrl.teachers.static import Decay, StaticTeacher, constant, cosine, exponential, limit_at, linear
from recrl.teachers.teacher import ProgressReport, Teacher, TeacherSpec

DECAYS = (linear, cosine, exponential)


def teacher(name: str, *, train: tuple[float, ...], deploy: tuple[float, ...], **options: float) -> Teacher:
    """A teacher with a budget of B = 100 environment steps."""
    return make_teacher(TeacherSpec(name, options, CostLimits(train), CostLimits(deploy), train_steps=100))


def report(update: int, env_steps: int, costs: Sequence[tuple[float, ...]] = ()) -> ProgressReport:
    """A report of one episode per entry of ``costs``."""
    limits = CostLimits.unlimited(len(costs[0])) if costs else CostLimits.unlimited(1)
    return ProgressReport(
        update,
        env_steps,
        tuple(
            EpisodeStats(b, Phase.TRAINING, env_steps, 1, 0.0, cost, limits, 0.0)
            for b, cost in enumerate(costs)
        ),
    )


@pytest.mark.parametrize(
    ("decay", "p", "limit"),
    [
        (linear, 0.25, 80.0),
        (linear, 0.5, 60.0),
        (cosine, 1 / 3, 20 + 80 * math.sqrt(3) / 2),
        (cosine, 2 / 3, 60.0),
        (exponential, math.log(2), 36.72093),  # (80 * 0.5 + 20 - 100 / e) / (1 - 1 / e)
        (exponential, 0.5, 50.20325),  # (80 * 0.6065307 + 20 - 100 / e) / (1 - 1 / e)
    ],
)
def test_decay_from_100_to_20_by_hand(decay: Decay, p: float, limit: float) -> None:
    assert decay(p, 100.0, 20.0) == pytest.approx(limit, abs=1e-5)


@pytest.mark.parametrize("decay", DECAYS)
def test_a_decay_goes_from_d_t_to_d_d(decay: Decay) -> None:
    assert decay(0.0, 250.0, 25.0) == pytest.approx(250.0)
    assert decay(1.0, 250.0, 25.0) == pytest.approx(25.0)


@pytest.mark.parametrize("p", [0.1, 0.5, 0.9])
def test_exponential_lies_below_linear_and_linear_below_cosine(p: float) -> None:
    assert exponential(p, 250.0, 25.0) < linear(p, 250.0, 25.0) < cosine(p, 250.0, 25.0)


@pytest.mark.parametrize("decay", [*DECAYS, constant])
def test_a_limit_is_d_d_exactly_from_the_end_of_the_budget_on(decay: Decay) -> None:
    assert limit_at(1.0, 0.3, 0.1, decay) == 0.1


@pytest.mark.parametrize("decay", [*DECAYS, constant])
@pytest.mark.parametrize("p", [0.0, 0.5, 0.99])
def test_an_infinite_start_stays_infinite_until_the_end(decay: Decay, p: float) -> None:
    assert limit_at(p, math.inf, 25.0, decay) == math.inf
    assert limit_at(p, math.inf, math.inf, decay) == math.inf


@pytest.mark.parametrize("limit", [math.nan, 24.0, 101.0, -1.0])
def test_a_decay_beyond_its_ends_is_an_error(limit: float) -> None:
    with pytest.raises(ValueError, match="the decay must be between d_d = 25 and d_t = 100, got"):
        limit_at(0.5, 100.0, 25.0, lambda p, train, deploy: limit)


def test_a_decay_that_rises_is_left_to_the_trial_to_refuse() -> None:
    spec = TeacherSpec("mine", {}, CostLimits((100.0,)), CostLimits((20.0,)), 100)
    teacher = StaticTeacher(spec, decay=lambda p, train, deploy: 30.0 if p < 0.5 else 40.0)
    _, state = teacher.start()
    limits = []
    for update in (1, 2):
        step, state = teacher.step(state, ProgressReport(update=update, env_steps=40 * update, episodes=()))
        limits.append(step.limits.values)
    assert limits == [(30.0,), (40.0,)]


def test_the_clock_counts_environment_steps() -> None:
    curriculum = teacher("linear", train=(100.0,), deploy=(20.0,))
    lesson, state = curriculum.start()
    assert lesson.limits == CostLimits((100.0,))
    lesson, state = curriculum.step(state, report(1, 25))
    assert lesson.limits == CostLimits((80.0,))
    lesson, state = curriculum.step(state, report(2, 75))
    assert lesson.limits == CostLimits((40.0,))
    lesson, state = curriculum.step(state, report(3, 130))
    assert lesson.limits == CostLimits((20.0,))


@pytest.mark.parametrize(
    ("name", "during"),
    [("none", (5.0, 1.0)), ("step", (50.0, math.inf)), ("unconstrained", (math.inf, math.inf))],
)
def test_a_control_holds_one_limit_until_deployment(name: str, during: tuple[float, ...]) -> None:
    control = teacher(name, train=(50.0, math.inf), deploy=(5.0, 1.0))
    lesson, state = control.start()
    assert lesson.limits == CostLimits(during)
    assert CostLimits.from_json(state["start_limits"]) == CostLimits(during)
    lesson, state = control.step(state, report(1, 99, [(70.0, 70.0)]))
    assert lesson.limits == CostLimits(during)
    lesson, state = control.step(state, report(2, 100, [(70.0, 70.0)]))
    assert lesson.limits == CostLimits((5.0, 1.0))


def test_an_infinite_start_is_measured_on_the_first_update() -> None:
    curriculum = teacher("linear", train=(math.inf,), deploy=(20.0,))
    lesson, state = curriculum.start()
    assert lesson.limits == CostLimits((math.inf,))
    assert state["start_limits"] is None
    lesson, state = curriculum.step(state, report(1, 25, [(90.0,), (110.0,)]))
    assert state["start_limits"] == [100.0]
    assert lesson.limits == CostLimits((80.0,))
    lesson, state = curriculum.step(state, report(2, 50, [(500.0,)]))
    assert state["start_limits"] == [100.0]
    assert lesson.limits == CostLimits((60.0,))


def test_a_start_is_measured_for_as_large_a_share_of_the_training_as_asked_for() -> None:
    curriculum = teacher("linear", train=(math.inf,), deploy=(20.0,), start_fraction=0.3)
    lesson, state = curriculum.start()
    lesson, state = curriculum.step(state, report(1, 25, [(60.0,), (120.0,)]))
    assert lesson.limits == CostLimits((math.inf,))
    lesson, state = curriculum.step(state, report(2, 50, [(120.0,)]))
    assert state["start_limits"] == [100.0]
    assert lesson.limits == CostLimits((60.0,))


def test_a_start_is_the_most_expensive_window_of_32_episodes() -> None:
    """The agent gets expensive as it learns, and then cheap again; the last window is not whole."""
    curriculum = teacher("linear", train=(math.inf,), deploy=(20.0,), start_fraction=0.4)
    _, state = curriculum.start()
    for update, (number, cost) in enumerate([(20, 30.0), (12, 190.0), (32, 80.0), (31, 300.0)], start=1):
        assert state["start_limits"] is None
        lesson, state = curriculum.step(state, report(update, 10 * update, [(cost,)] * number))
    assert state["start_limits"] == [90.0]
    assert lesson.limits == CostLimits((62.0,))


def test_measuring_goes_on_until_an_episode_has_finished() -> None:
    curriculum = teacher("linear", train=(math.inf,), deploy=(20.0,))
    _, state = curriculum.start()
    for update, env_steps in ((1, 25), (2, 40)):
        lesson, state = curriculum.step(state, report(update, env_steps))
        assert lesson.limits == CostLimits((math.inf,))
    lesson, state = curriculum.step(state, report(3, 50, [(100.0,)]))
    assert lesson.limits == CostLimits((60.0,))


def test_a_measured_start_is_at_least_d_d_and_leaves_finite_dimensions_alone() -> None:
    curriculum = teacher("linear", train=(math.inf, 100.0), deploy=(20.0, 0.0), start_fraction=0.3)
    _, state = curriculum.start()
    lesson, state = curriculum.step(state, report(1, 25, [(3.0, 7.0)]))
    assert lesson.limits == CostLimits((math.inf, 75.0))
    lesson, state = curriculum.step(state, report(2, 50, [(3.0, 7.0)]))
    assert state["start_limits"] == [20.0, 100.0]
    assert lesson.limits == CostLimits((20.0, 50.0))
