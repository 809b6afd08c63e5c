"""The dynamic curriculum, rule by rule and in a closed loop with simulated agents."""

import itertools
import math
from typing import Any

import numpy as np
import pytest

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.teachers.dynamic import DynamicTeacher
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.dynamic_rules import (
    decide,
    has_converged,
    is_precise,
    keeps_limit,
    next_limit,
    steps_left,
)
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState
from recrl.teachers.windows import WindowStatistics
from tests.teachers.closed_loop import noises, obedient, play, recovering

SPLIT_AT_100 = (slice(0, 100), slice(100, None))


def window(mean_return: float, cost: float, *, episodes: int = 4, scatter: float = 0.0) -> WindowStatistics:
    return WindowStatistics(100, episodes, mean_return, (cost,), (scatter,))


def decided(
    old: WindowStatistics, new: WindowStatistics, *, limit: float, deploy: float, **options: Any
) -> tuple[float, float]:
    """Limit and noise after a judgement with five steps left."""
    config = DynamicConfig.model_validate(options)
    return decide(old, new, limit=limit, deploy_limit=deploy, remaining=5, config=config)


# Line 5: convergence.


@pytest.mark.parametrize(
    ("new", "old", "converged"),
    [
        (11.0, 10.0, True),
        (11.1, 10.0, False),
        (9.0, 10.0, True),
        (-11.0, -10.0, True),
        (-11.1, -10.0, False),
        (0.0, 0.0, True),
        (0.01, 0.0, False),
        (0.01, -0.01, False),
    ],
)
def test_without_a_floor_convergence_is_the_ratio_test_of_the_paper(
    new: float, old: float, converged: bool
) -> None:
    assert has_converged(new, old, tolerance=0.1, floor=0.0) is converged
    if old != 0.0 and new not in (11.0, 9.0, -11.0):  # there the ratio is 0.1 up to rounding
        assert (abs(new / old - 1) <= 0.1) is converged


def test_a_floor_ignores_changes_of_means_near_zero() -> None:
    assert has_converged(0.05, -0.05, tolerance=0.1, floor=1.0)
    assert not has_converged(0.2, 0.0, tolerance=0.1, floor=1.0)


# Line 6: adherence.


def test_a_mean_cost_may_exceed_its_limit_by_the_tolerance() -> None:
    assert keeps_limit(5.004, 5.0, tolerance=0.01)
    assert not keeps_limit(5.02, 5.0, tolerance=0.01)
    assert not keeps_limit(5.004, 5.0, tolerance=0.0)
    assert keeps_limit(0.1 + 0.2, 0.3, tolerance=0.0)


def test_the_relative_tolerance_is_a_standard_error_where_episodes_are_few() -> None:
    few = window(9.5, 6.0, scatter=12.0)  # standard error 1
    assert decided(few, few, limit=5.0, deploy=5.0) == (5.0, 0.0)


def test_the_relative_tolerance_of_a_small_limit_is_that_of_the_floor() -> None:
    careful, careless = window(9.5, 0.1), window(9.5, 0.11)
    assert decided(careful, careful, limit=0.0, deploy=0.0) == (0.0, 0.0)
    assert decided(careless, careless, limit=0.0, deploy=0.0) == (0.0, 0.3)


# Line 7: the step.


@pytest.mark.parametrize(
    ("limit", "cost", "remaining", "lowered"),
    [
        (100.0, 65.0, 6, 55.0),  # 65 - (65 - 5) / 6
        (math.inf, 65.0, 6, 55.0),
        (100.0, 65.0, 1, 5.0),
        (100.0, 65.0, 0, 5.0),
        (100.0, 65.0, -1, 5.0),
        (53.0, 55.0, 6, 45.0),  # from the limit, 53 - (53 - 5) / 6, where the cost is above it
        (100.0, 3.0, 6, 5.0),
        (5.0, 3.0, 6, 5.0),
    ],
)
def test_step_towards_a_deployment_limit_of_5_by_hand(
    limit: float, cost: float, remaining: int, lowered: float
) -> None:
    assert next_limit(limit, cost, 5.0, remaining=remaining) == lowered


def test_steps_left_are_estimated_from_the_last_window() -> None:
    last = WindowStatistics(
        env_steps=300, episodes=6, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,)
    )
    assert steps_left(last, env_steps=4000, train_steps=5000, duration=0) == 1  # 3 windows fit


# Lines 5 to 11 together.


def test_a_converged_agent_that_keeps_its_limit_gets_a_lower_one() -> None:
    assert decided(window(9.0, 60.0), window(9.5, 55.0), limit=60.0, deploy=5.0) == (45.0, 0.0)


@pytest.mark.parametrize("new", [window(5.0, 55.0), window(9.5, 40.0)], ids=["return", "cost"])
def test_an_agent_that_still_changes_is_left_alone(new: WindowStatistics) -> None:
    assert decided(window(9.0, 60.0), new, limit=60.0, deploy=5.0) == (60.0, 0.0)


def test_a_converged_agent_above_its_limit_gets_noise() -> None:
    stuck = window(9.5, 5.0)
    assert decided(stuck, stuck, limit=1.0, deploy=1.0, policy_noise=0.2) == (1.0, 0.2)


def test_a_dimension_never_blocks_another() -> None:
    budget: dict[str, Any] = {"deploy": (5.0, 5.0), "updates": 50}
    stuck = play(lambda step, update: (9.5, (55.0, 9.0)), train=(60.0, 5.0), **budget)
    assert stuck.limits[9] == pytest.approx((55.0 - 50.0 / 6, 5.0))
    assert stuck.noise[9] == 0.3
    moving = play(lambda step, update: (9.5, (55.0, 2.0**update)), train=(60.0, 30.0), **budget)
    assert moving.limits[9] == pytest.approx((55.0 - 50.0 / 6, 30.0))
    assert moving.noise[9] == 0.0


# The clock.


def test_the_first_judgement_takes_two_windows_and_every_other_one() -> None:
    run = play(obedient, train=(100.0,), deploy=(60.0,), updates=100, window=4)
    changes = [update for update in range(2, 40) if run.limits[update - 1] != run.limits[update - 2]]
    assert changes == [8, 12, 16, 20, 24, 28, 32, 36]


@pytest.mark.parametrize("episodes", [2, 500])
@pytest.mark.parametrize("deploy", [0.0, 5.0, 25.0])
def test_an_ideal_agent_is_led_to_d_d_two_windows_before_the_end(episodes: int, deploy: float) -> None:
    run = play(obedient, train=(250.0,), deploy=(deploy,), updates=285, episodes=lambda step: episodes)
    steps = [before[0] - after[0] for before, after in zip(run.limits, run.limits[1:], strict=False)]
    assert run.limits[-11] == (deploy,)
    assert max(steps) < 16.0
    assert not any(run.noise)


def test_an_agent_that_stays_and_then_crosses_is_judged_in_both_regimes() -> None:
    """RiverGrid: 16 long episodes a batch as long as the agent stays, 500 short ones once it crosses."""
    batch = iter([16] * 100 + [500] * 185)

    def crosses_after_100(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        return (-20.0, (80.0,)) if update <= 100 else (9.5, (min(40.0, step.limits[0]),))

    run = play(
        crosses_after_100,
        train=(100.0,),
        deploy=(5.0,),
        updates=285,
        episodes=lambda step: next(batch),
    )
    kicks_before, kicks_after = (sum(noise > 0.0 for noise in run.noise[part]) for part in SPLIT_AT_100)
    assert run.limits[98][0] == pytest.approx(80.0 - 6 * 75.0 / 53)  # 80 is more than a tenth above that
    assert kicks_before == 7  # at 40, 50, ..., 100
    assert 20.0 < run.limits[150][0] < 40.0
    assert kicks_after == 0
    assert run.limits[-6] == (5.0,)


def test_a_stuck_agent_is_kicked_again_and_again_but_not_after_the_end() -> None:
    run = play(lambda step, update: (9.5, (5.0,)), train=(1.0,), deploy=(1.0,), updates=40, window=4)
    assert [update for update, noise in enumerate(run.noise, start=1) if noise > 0.0] == [8, 16, 24, 32]
    assert set(run.limits) == {(1.0,)}


def test_what_noise_does_to_the_costs_is_not_taken_for_being_stuck() -> None:
    assert noises(recovering(), updates=100) == [10]


def test_an_agent_that_noise_frees_reaches_d_d() -> None:
    """RiverGrid 1b: the agent crosses at cost 5 whatever the limit, until two kicks have freed it."""
    kicks = 0
    seen = 0

    def crosses_until_kicked(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        nonlocal kicks, seen
        if step.policy_noise > 0.0 and seen != update:
            kicks, seen = kicks + 1, update
        return (9.5, (5.0,)) if kicks < 2 else (9.0, (0.0,))

    run = play(crosses_until_kicked, train=(5.0,), deploy=(1.0,), updates=200)
    assert kicks == 2
    assert run.limits[-10] == (1.0,)


def test_a_perfectly_safe_agent_is_not_waited_for_for_ever() -> None:
    run = play(lambda step, update: (0.0, (0.0,)), train=(100.0,), deploy=(25.0,), updates=50)
    assert run.limits[9] == (25.0,)


def test_an_agent_that_never_converges_meets_d_d_at_the_end() -> None:
    run = play(lambda step, update: (2.0**update, (1.0,)), train=(100.0,), deploy=(25.0,), updates=50)
    assert run.limits[-2:] == [(100.0,), (25.0,)]


def test_an_infinite_start_is_kept_until_the_first_judgement_or_measured() -> None:
    def costs_65(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        return 9.5, (65.0,)

    kept = play(costs_65, train=(math.inf,), deploy=(5.0,), updates=40, start_fraction=0.0)
    assert kept.limits[8:10] == [(math.inf,), (50.0,)]  # 65 - 60 / 4: six windows are left
    assert kept.state["start_limits"] == ["inf"]
    measured = play(costs_65, train=(math.inf,), deploy=(5.0,), updates=40, start_fraction=0.02)
    assert measured.limits[0] == (65.0,)
    assert measured.limits[8:10] == [(65.0,), (50.0,)]
    assert measured.state["start_limits"] == [65.0]


def test_a_difficult_dimension_delays_an_easy_one_by_at_most_a_window() -> None:
    def second_is_hopeless(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        return 9.5, (step.limits[0], 40.0 + 20.0 * (update % 7))

    alone = play(obedient, train=(100.0,), deploy=(5.0,), updates=200)
    for deploy, train in ((1.0, 1.0), (1.0, 90.0), (1.0, math.inf)):
        both = play(second_is_hopeless, train=(100.0, train), deploy=(5.0, deploy), updates=200)
        assert both.limits[-6][0] == 5.0
        pairs = zip(alone.limits[:-5], both.limits[5:], strict=True)
        assert all(delayed[0] <= easy[0] + 3.0 for easy, delayed in pairs)


def test_the_state_stays_small() -> None:
    run = play(obedient, train=(250.0,), deploy=(5.0,), updates=100, episodes=lambda step: 100)
    assert [cost["history"] for cost in run.state["costs"]] == [[]]
    teacher = make_teacher(
        TeacherSpec("dynamic", {}, CostLimits((250.0,)), CostLimits((5.0,)), train_steps=10**6)
    )
    _, state = teacher.start()
    for update in range(1, 50):
        episodes = (EpisodeStats(0, Phase.TRAINING, update, 1, 1.0, (9.0,), CostLimits((9.0,)), 0.0),) * 30
        _, state = teacher.step(state, ProgressReport(update, update, episodes))
    assert all(len(cost["history"]) <= 10 for cost in state["costs"])


def test_noise_is_not_judged_before_there_are_enough_episodes() -> None:
    """Eight episodes of a policy whose cost scatters as much as its mean look converged by chance."""
    generator = np.random.default_rng(0)

    def noisy(number: int) -> WindowStatistics:
        costs = generator.exponential(50.0, number)
        episodes = [
            EpisodeStats(
                b, Phase.TRAINING, 0, 1000, float(cost) / 10.0, (float(cost),), CostLimits((25.0,)), 0.0
            )
            for b, cost in enumerate(costs)
        ]
        return WindowStatistics.of_update(episodes, env_steps=8000, num_costs=1)

    config = DynamicConfig()
    assert not any(is_precise(noisy(8), config) for _ in range(100))
    assert all(is_precise(noisy(100), config) for _ in range(20))
    assert is_precise(
        window(9.5, 5.0, episodes=10), config
    )  # deterministic: no more than the least are needed
    assert not is_precise(window(9.5, 5.0, episodes=9), config)
    assert not is_precise(WindowStatistics(100, 0, 0.0, (0.0,), (0.0,)), config)


@pytest.mark.parametrize(("episodes", "error"), [(100, 0.1), (400, 0.05)])
def test_a_constant_policy_passes_as_often_as_the_standard_errors_of_its_means_say(
    episodes: int, error: float
) -> None:
    """The difference of two means has sqrt(2) times their standard error, here in standard deviations."""
    tolerance, pairs = 0.1, 4000
    returns = np.random.default_rng(0).normal(0.0, 5.0, (pairs, 2, episodes))
    means, scatters = returns.mean(axis=2), returns.var(axis=2) * episodes
    passed = 0
    for (old, new), (old_scatter, new_scatter) in zip(means, scatters, strict=True):
        limit, _ = decided(
            WindowStatistics(1, episodes, float(old), (9.0,), (0.0,), float(old_scatter)),
            WindowStatistics(1, episodes, float(new), (9.0,), (0.0,), float(new_scatter)),
            limit=9.0,
            deploy=5.0,
            return_tolerance=tolerance,
        )
        passed += limit < 9.0  # only a converged limit falls; the cost is constant
    expected = math.erf(tolerance / (2.0 * error))  # 52% and 84%
    assert passed / pairs == pytest.approx(expected, abs=0.03)


def test_a_noisy_agent_is_held_where_it_is_until_a_hundred_episodes_say_that_it_has_converged() -> None:
    generator = np.random.default_rng(1)
    spec = TeacherSpec("dynamic", {"window": 2}, CostLimits((200.0,)), CostLimits((25.0,)), 1_000_000)
    teacher = make_teacher(spec)
    step, state = teacher.start()
    changes, episodes_at_change, total = 0, [], 0
    for update in range(1, 240):
        limits = step.limits
        costs = generator.exponential(80.0, 4)
        episodes = tuple(
            EpisodeStats(
                b, Phase.TRAINING, 4096 * update, 1000, float(cost) / 10.0, (float(cost),), limits, 0.0
            )
            for b, cost in enumerate(costs)
        )
        total += len(episodes)
        step, state = teacher.step(state, ProgressReport(update, 4096 * update, episodes))
        if step.limits != limits and 4096 * update < 1_000_000:
            changes += 1
            episodes_at_change.append(total)
    assert 2 <= changes <= 6
    assert episodes_at_change[0] >= 2 * 75


def test_no_decision_comes_from_fewer_than_ten_and_ten_episodes(monkeypatch: Any) -> None:
    """With 4 x 64 steps an update and episodes of 1000, an update has a quarter of an episode."""
    compared: list[tuple[int, int]] = []

    def recorded(old: WindowStatistics, new: WindowStatistics, **keywords: Any) -> tuple[float, float]:
        compared.append((old.episodes, new.episodes))
        return decide(old, new, **keywords)

    monkeypatch.setattr("recrl.teachers.dynamic.decide", recorded)
    generator = np.random.default_rng(2)
    spec = TeacherSpec("dynamic", {"window": 5}, CostLimits((200.0,)), CostLimits((25.0,)), 1_000_000)
    teacher = make_teacher(spec)
    step, state = teacher.start()
    for update in range(1, 400):
        count = 4 * ((256 * update) // 4000 > (256 * (update - 1)) // 4000)  # four end together
        episodes = tuple(
            EpisodeStats(b, Phase.TRAINING, 0, 1000, 10.0, (float(cost),), step.limits, 0.0)
            for b, cost in enumerate(generator.choice([20.0, 20.0, 20.0, 60.0], count))
        )
        step, state = teacher.step(state, ProgressReport(update, 256 * update, episodes))
    assert compared
    assert min(map(min, compared)) >= 10


def several_costs(kinds: tuple[tuple[float, bool], ...], *, seed: int) -> tuple[list[int], int]:
    """An agent whose costs scatter and obey their limits, or are stuck above them; 4 episodes an update.

    Args:
        kinds: of each cost its relative standard deviation, and whether it is stuck at 40 under 30.
        seed: of the costs.

    Returns:
        The number of changes of each limit in 470 updates, and that of noises.
    """
    generator = np.random.default_rng(seed)
    train = tuple(30.0 if stuck else 100.0 for _, stuck in kinds)
    deploy = tuple(30.0 if stuck else 25.0 for _, stuck in kinds)
    teacher = make_teacher(TeacherSpec("dynamic", {}, CostLimits(train), CostLimits(deploy), 470))
    step, state = teacher.start()
    changes, noises = [0] * len(kinds), 0
    for update in range(1, 470):
        means = [40.0 if stuck else limit for limit, (_, stuck) in zip(step.limits, kinds, strict=True)]
        costs = [
            np.maximum(generator.normal(mean, spread * mean, 4), 0.0)
            for mean, (spread, _) in zip(means, kinds, strict=True)
        ]
        finished = tuple(
            EpisodeStats(
                0, Phase.TRAINING, update, 1, float(generator.normal(20.0, 1.0)), each, step.limits, 0.0
            )
            for each in zip(*(column.tolist() for column in costs), strict=True)
        )
        old = step
        step, state = teacher.step(state, ProgressReport(update, update, finished))
        changes = [
            count + (new != before)
            for count, new, before in zip(changes, step.limits, old.limits, strict=True)
        ]
        noises += step.policy_noise > 0.0
    return changes, noises


@pytest.mark.parametrize("seed", range(3))
def test_a_cost_with_long_windows_is_not_held_up_by_one_with_short_windows(seed: int) -> None:
    [alone], _ = several_costs(((0.8, False),), seed=seed)
    (quick, slow), _ = several_costs(((0.1, False), (0.8, False)), seed=seed)
    assert quick > 2 * slow
    assert slow >= 0.7 * alone
    (stuck, beside), noises = several_costs(((0.05, True), (0.8, False)), seed=seed)
    assert stuck == 0
    assert beside >= 4  # noise waits until it has had two windows
    assert noises >= 10


# Episodes that began before a change.


def long_episodes(
    teacher: DynamicTeacher, *, horizon: int, seed: int, short: float = 0.0, all_count: bool = False
) -> tuple[int, int, list[float]]:
    """An agent that obeys each limit at once, in 64 environments with 64 steps an update.

    Each episode's cost scatters by a factor of its own; a step costs what the limit then in force allows.

    Args:
        teacher: the curriculum.
        horizon: steps of an episode.
        seed: of the costs.
        short: the share of episodes with 20 steps and without cost; the others cost more for it.
        all_count: whether reports leave out when an episode began, so that the curriculum counts all.

    Returns:
        The number of changes of the limit, that of noises, and the limits.
    """
    envs, steps, budget = 64, 64, teacher.spec.train_steps
    generator = np.random.default_rng(seed)
    step, state = teacher.start()
    ages = np.arange(envs) * horizon // envs
    lengths = np.full(envs, horizon)
    factors = np.maximum(generator.normal(1.0, 0.3, envs), 0.0)
    costs = ages * step.limits[0] / horizon * factors
    changes, noises, limits = 0, 0, []
    for update in range(1, budget // (envs * steps) + 1):
        before, finished = (update - 1) * envs * steps, []
        for done in range(1, steps + 1):
            costs += step.limits[0] / horizon * factors
            ages += 1
            for env in np.flatnonzero(ages == lengths):
                end = before + done * envs
                finished.append(
                    EpisodeStats(
                        0,
                        Phase.TRAINING,
                        end,
                        int(lengths[env]),
                        20.0 + float(generator.normal(0.0, 3.0)),
                        (float(costs[env]),),
                        step.limits,
                        0.0,
                        begin_step=None if all_count else end - int(lengths[env]) * envs,
                    )
                )
                ages[env], costs[env] = 0, 0.0
                factors[env] = max(generator.normal(1.0, 0.3), 0.0) / (1.0 - short)
                lengths[env] = horizon
                if short and generator.random() < short:
                    lengths[env], factors[env] = 20, 0.0
        old = step
        report = ProgressReport(update, update * envs * steps, tuple(finished))
        step, state = teacher.step(state, report)
        changes += step.limits != old.limits
        noises += step.policy_noise > 0.0
        limits.append(step.limits[0])
    return changes, noises, limits


def teacher_of(budget: int = 950_000, **options: Any) -> DynamicTeacher:
    return DynamicTeacher(TeacherSpec("dynamic", options, CostLimits((250.0,)), CostLimits((25.0,)), budget))


@pytest.mark.parametrize("seed", range(3))
def test_an_obedient_agent_gets_little_noise_if_earlier_episodes_do_not_count(seed: int) -> None:
    changes, noises, limits = long_episodes(teacher_of(), horizon=1000, seed=seed)
    assert noises <= 3  # by chance: a mean a little above its limit
    assert 5 <= changes <= 12
    assert limits[-1] == 25.0
    reached = limits.index(25.0) / len(limits)
    assert 0.6 <= reached <= 0.95
    _, disturbed, _ = long_episodes(teacher_of(), horizon=1000, seed=seed, all_count=True)
    assert disturbed >= 4


def test_short_episodes_hardly_overlap_a_change() -> None:
    ignored, _, _ = long_episodes(teacher_of(), horizon=64, seed=0)
    counted, _, _ = long_episodes(teacher_of(), horizon=64, seed=0, all_count=True)
    assert ignored == pytest.approx(counted, rel=0.1)


def test_no_episode_counts_that_ends_within_the_longest_one_after_a_change() -> None:
    teacher = teacher_of(100_000, window=1)

    def reported(state: TeacherState, update: int, length: int, cost: float) -> Any:
        end = 1000 * update
        episode = EpisodeStats(
            0, Phase.TRAINING, end, 10, 9.5, (cost,), CostLimits((250.0,)), 0.0, begin_step=end - length
        )
        return teacher.step(state, ProgressReport(update, end, (episode,) * 10))

    _, state = teacher.start()
    _, state = reported(state, 1, 500, 250.0)
    step, state = reported(state, 2, 1500, 250.0)
    assert step.limits[0] < 250.0
    assert state["costs"][0]["changed_at"] == 2000
    lowered = step.limits
    for length in (1500, 10):  # of before the change, and after it: a short one may be the cheap one
        ignored, unchanged = reported(state, 3, length, 0.0)
        assert (ignored.limits, ignored.policy_noise) == (lowered, 0.0)
    step, _ = reported(unchanged, 4, 1500, lowered[0])  # the older window is that of before the change
    assert 25.0 < step.limits[0] < lowered[0]


@pytest.mark.parametrize("seed", range(3))
def test_short_and_cheap_episodes_do_not_take_the_limit_to_d_d_at_once(seed: int) -> None:
    """Half of the episodes have 20 steps and cost nothing; the mean cost obeys the limit."""
    teacher = teacher_of(2_000_000)
    _, _, limits = long_episodes(teacher, horizon=1000, seed=seed, short=0.5)
    before = [limit for limit in limits if limit < 250.0]
    assert before[0] > 150.0
    assert sum(new < old for old, new in itertools.pairwise(limits)) >= 4


def test_the_remaining_steps_allow_for_an_episode_before_each_window() -> None:
    last = WindowStatistics(1000, episodes=8, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,))
    left = [
        steps_left(last, env_steps=0, train_steps=20_000, duration=duration) for duration in (0, 1000, 4000)
    ]
    assert left == [18, 8, 2]  # 20 - 2; (20 - 3) / 2; (20 - 6) / 5
