"""Algorithm 2, line by line and in a closed loop with simulated agents."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
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

SPLIT_AT_100 = (slice(0, 100), slice(100, None))

# An episode of a simulated agent, (return, costs), from the step and the update's index.
Agent = Callable[[CurriculumStep, int], tuple[float, tuple[float, ...]]]


def window(mean_return: float, *costs: float, episodes: int = 4, scatter: float = 0.0) -> WindowStatistics:
    return WindowStatistics(100, episodes, mean_return, costs, (scatter,) * len(costs))


def decided(
    old: WindowStatistics,
    new: WindowStatistics,
    *,
    limits: tuple[float, ...],
    deploy: tuple[float, ...],
    **options: Any,
) -> tuple[tuple[float, ...], float]:
    """Limits and noise after a judgement with five steps left."""
    step = decide(
        old,
        new,
        limits=CostLimits(limits),
        deploy_limits=CostLimits(deploy),
        remaining=5,
        config=DynamicConfig.model_validate(options),
    )
    return step.limits.values, step.policy_noise


@dataclass(frozen=True)
class Run:
    """What a teacher did: limits and noise after each update, and its last state."""

    limits: list[tuple[float, ...]]
    noise: list[float]
    state: TeacherState


def play(
    agent: Agent,
    *,
    train: tuple[float, ...],
    deploy: tuple[float, ...],
    updates: int,
    episodes: Callable[[CurriculumStep], int] = lambda step: 16,
    **options: Any,
) -> Run:
    """A closed loop over a budget of ``updates`` updates, of one environment step each."""
    teacher = make_teacher(
        TeacherSpec("dynamic", options, CostLimits(train), CostLimits(deploy), train_steps=updates)
    )
    step, state = teacher.start()
    run = Run([], [], state)
    for update in range(1, updates + 1):
        finished = []
        for b in range(episodes(step)):
            episode_return, costs = agent(step, update)
            finished.append(
                EpisodeStats(b, Phase.TRAINING, update, 1, episode_return, costs, step.limits, 0.0)
            )
        step, state = teacher.step(state, ProgressReport(update, update, tuple(finished)))
        run.limits.append(step.limits.values)
        run.noise.append(step.policy_noise)
    return Run(run.limits, run.noise, state)


def obedient(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
    """An ideal agent: its costs are at the limits at once."""
    return 9.5, step.limits.values


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


@pytest.mark.parametrize(
    ("tolerance", "cost", "kept"),
    [
        ("none", 5.0, True),
        ("none", 5.01, False),
        ("standard_error", 5.1, True),
        ("standard_error", 5.11, False),
        ("relative", 5.5, True),
        ("relative", 5.51, False),
    ],
)
def test_the_tolerance_by_its_names(tolerance: str, cost: float, kept: bool) -> None:
    crossing = window(9.5, cost, scatter=0.12)  # standard error sqrt(0.12 / 3 / 4) = 0.1
    noise = 0.0 if kept else 0.3
    assert decided(crossing, crossing, limits=(5.0,), deploy=(5.0,), adherence_tolerance=tolerance) == (
        (5.0,),
        noise,
    )


def test_the_relative_tolerance_is_a_standard_error_where_episodes_are_few() -> None:
    few = window(9.5, 6.0, scatter=12.0)  # standard error 1
    assert decided(few, few, limits=(5.0,), deploy=(5.0,)) == ((5.0,), 0.0)


def test_the_relative_tolerance_of_a_small_limit_is_that_of_the_floor() -> None:
    careful, careless = window(9.5, 0.1), window(9.5, 0.11)
    assert decided(careful, careful, limits=(0.0,), deploy=(0.0,)) == ((0.0,), 0.0)
    assert decided(careless, careless, limits=(0.0,), deploy=(0.0,)) == ((0.0,), 0.3)


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


def test_a_dimension_that_is_never_constrained_stays_so() -> None:
    assert next_limit(math.inf, 3.0, math.inf, remaining=2) == math.inf


def test_steps_left_are_estimated_from_the_last_window() -> None:
    last = WindowStatistics(
        env_steps=300, episodes=6, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,)
    )
    assert steps_left(last, env_steps=4000, train_steps=5000, unit="windows") == 1  # 3 windows fit
    assert steps_left(last, env_steps=4000, train_steps=5000, unit="episodes") == 19


# Lines 5 to 11 together.


def test_a_converged_agent_that_keeps_its_limit_gets_a_lower_one() -> None:
    assert decided(window(9.0, 60.0), window(9.5, 55.0), limits=(60.0,), deploy=(5.0,)) == ((45.0,), 0.0)


@pytest.mark.parametrize("new", [window(5.0, 55.0), window(9.5, 40.0)], ids=["return", "cost"])
def test_an_agent_that_still_changes_is_left_alone(new: WindowStatistics) -> None:
    assert decided(window(9.0, 60.0), new, limits=(60.0,), deploy=(5.0,)) == ((60.0,), 0.0)


def test_a_converged_agent_above_its_limit_gets_noise() -> None:
    stuck = window(9.5, 5.0)
    assert decided(stuck, stuck, limits=(1.0,), deploy=(1.0,), policy_noise=0.2) == ((1.0,), 0.2)


def test_a_window_without_episodes_is_no_evidence() -> None:
    nothing = window(0.0, 0.0, episodes=0)
    assert decided(nothing, nothing, limits=(60.0,), deploy=(5.0,)) == ((60.0,), 0.0)


def test_a_dimension_never_blocks_another() -> None:
    kept, stuck, moving = window(9.5, 55.0, 9.0), window(9.5, 55.0, 9.0), window(9.5, 55.0, 20.0)
    assert decided(kept, stuck, limits=(60.0, 5.0), deploy=(5.0, 5.0)) == ((45.0, 5.0), 0.3)
    assert decided(kept, moving, limits=(60.0, 30.0), deploy=(5.0, 5.0)) == ((45.0, 30.0), 0.0)


def test_jointly_all_dimensions_wait_for_the_last() -> None:
    kept, stuck, moving = window(9.5, 55.0, 9.0), window(9.5, 55.0, 9.0), window(9.5, 55.0, 20.0)
    joint = {"dimensions": "joint"}
    assert decided(kept, stuck, limits=(60.0, 5.0), deploy=(5.0, 5.0), **joint) == ((60.0, 5.0), 0.3)
    assert decided(kept, moving, limits=(60.0, 30.0), deploy=(5.0, 5.0), **joint) == ((60.0, 30.0), 0.0)
    assert decided(kept, kept, limits=(60.0, 30.0), deploy=(5.0, 5.0), **joint) == ((45.0, 8.2), 0.0)


# The clock.


def test_the_first_judgement_takes_two_windows_and_every_other_one() -> None:
    run = play(obedient, train=(100.0,), deploy=(60.0,), updates=100, window=4)
    changes = [update for update in range(2, 40) if run.limits[update - 1] != run.limits[update - 2]]
    assert changes == [8, 12, 16, 20, 24, 28, 32, 36]


@pytest.mark.parametrize(
    ("options", "episodes", "updates_in_a_window"),
    [
        ({"window": 5}, 2, 5),
        ({"window": 5}, 500, 5),
        ({"window": 80, "window_unit": "episodes"}, 16, 5),
        ({"window": 80, "window_unit": "episodes"}, 500, 1),
    ],
)
@pytest.mark.parametrize("deploy", [0.0, 5.0, 25.0])
def test_an_ideal_agent_is_led_to_d_d_two_windows_before_the_end(
    options: dict[str, Any], episodes: int, updates_in_a_window: int, deploy: float
) -> None:
    run = play(
        obedient, train=(250.0,), deploy=(deploy,), updates=285, episodes=lambda step: episodes, **options
    )
    steps = [before[0] - after[0] for before, after in zip(run.limits, run.limits[1:], strict=False)]
    assert run.limits[-1 - 2 * updates_in_a_window] == (deploy,)
    assert max(steps) < 16.0
    assert not any(run.noise)


@pytest.mark.parametrize(
    ("options", "updates_in_a_window"), [({"window": 5}, 5), ({"window": 80, "window_unit": "episodes"}, 1)]
)
def test_an_agent_that_stays_and_then_crosses_is_judged_in_both_regimes(
    options: dict[str, Any], updates_in_a_window: int
) -> None:
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
        **options,
    )
    kicks_before, kicks_after = (sum(noise > 0.0 for noise in run.noise[part]) for part in SPLIT_AT_100)
    assert run.limits[98][0] == pytest.approx(80.0 - 6 * 75.0 / 53)  # 80 is more than a tenth above that
    assert kicks_before == 7  # at 40, 50, ..., 100
    assert 20.0 < run.limits[150][0] < 40.0
    assert kicks_after == 0
    assert run.limits[-1 - updates_in_a_window] == (5.0,)


def test_literal_steps_leave_an_ideal_agent_far_above_d_d() -> None:
    """Line 7 with B - b in episodes: from 250, the limit gets to about 158, by the product of its factors.

    Episode b = 21, 31, ... is the one about to be played when 20, 30, ... are.
    """
    run = play(
        obedient,
        train=(250.0,),
        deploy=(25.0,),
        updates=1000,
        episodes=lambda step: 1,
        preset="paper",
        window=10,
    )
    factors = [1.0 - 1.0 / (1000 - b) for b in range(21, 1000, 10)]
    assert run.limits[-2][0] == pytest.approx(25.0 + 225.0 * math.prod(factors))
    assert run.limits[-2][0] > 150.0
    assert run.limits[-1] == (25.0,)


def algorithm_2(
    costs: list[float], *, train: float, deploy: float, window: int, tolerance: float
) -> list[tuple[float, bool]]:
    """The pseudocode of Algorithm 2 for k = 1, line by line: the limit and noise of every episode b.

    Args:
        costs: C(b) of the episodes 1, ..., B; every return is 1.
        train: d_t.
        deploy: d_d.
        window: W.
        tolerance: eps_c.
    """
    budget, limit, last_change, taught = len(costs), train, 0, []  # line 2
    for b in range(1, budget + 1):  # line 3
        noise = False
        if b > 2 * window and last_change >= window:  # line 4; at b = 2 W only 2 W - 1 are played
            new = math.fsum(costs[b - 1 - window : b - 1]) / window
            old = math.fsum(costs[b - 1 - 2 * window : b - 1 - window]) / window
            if abs(new / old - 1.0) <= tolerance:  # line 5
                if new <= limit:  # line 6
                    # line 7; at b = B it divides by 0, and d_d is meant
                    limit = max(deploy, new - (new - deploy) / (budget - b)) if b < budget else deploy
                else:  # line 8
                    noise = True  # line 9
                last_change = 0  # line 11
        taught.append((limit, noise))  # line 14 plays under these
        last_change += 1  # line 15
    return taught


@pytest.mark.parametrize("seed", range(8))
def test_the_preset_paper_is_algorithm_2_episode_by_episode(seed: int) -> None:
    """Costs that stand still, jump and fall, also below d_d, where nothing changes and line 11 resets."""
    generator = np.random.default_rng(seed)
    levels = np.concatenate([np.linspace(56.0, 30.0, 6), generator.uniform(2.0, 80.0, 8)])
    costs = [round(float(cost * generator.uniform(0.95, 1.05)), 3) for cost in np.repeat(levels, 25)]
    expected = algorithm_2(costs, train=60.0, deploy=20.0, window=5, tolerance=0.1)
    run = play(
        lambda step, update: (1.0, (costs[update - 1],)),
        train=(60.0,),
        deploy=(20.0,),
        updates=len(costs),
        episodes=lambda step: 1,
        preset="paper",
        window=5,
    )
    taught = [
        (60.0, False),
        *zip((d for (d,) in run.limits), (noise > 0.0 for noise in run.noise), strict=True),
    ]
    for (limit, noise), (literal, literal_noise) in zip(taught[:-1], expected, strict=True):
        assert limit == pytest.approx(literal, rel=1e-12)
        assert noise == literal_noise
    assert len({limit for limit, _ in expected}) > 3
    assert any(noise for _, noise in expected)


def test_literally_the_clock_begins_anew_also_where_nothing_changes() -> None:
    """At d_d line 7 changes nothing; line 11 resets the clock all the same, so a jump is answered later."""

    def jumps(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        return 9.5, (5.0 if update <= 12 else 7.0,)

    def kicked_first(clock_reset: str) -> int:
        run = play(
            jumps,
            train=(5.0,),
            deploy=(5.0,),
            updates=60,
            episodes=lambda step: 3,
            window=4,
            cost_tolerance=0.5,
            adherence_tolerance="none",
            clock_reset=clock_reset,
        )
        return next(update for update, noise in enumerate(run.noise, start=1) if noise > 0.0)

    assert kicked_first("change") == 13
    assert kicked_first("convergence") == 16  # judged at 8, 12 and 16 only


@pytest.mark.parametrize(
    ("after_noise", "kicks"), [(2, [8, 16, 24, 32]), (1, [8, 12, 16, 20, 24, 28, 32, 36])]
)
def test_a_stuck_agent_is_kicked_again_and_again_but_not_after_the_end(
    after_noise: int, kicks: list[int]
) -> None:
    run = play(
        lambda step, update: (9.5, (5.0,)),
        train=(1.0,),
        deploy=(1.0,),
        updates=40,
        window=4,
        windows_after_noise=after_noise,
    )
    assert [update for update, noise in enumerate(run.noise, start=1) if noise > 0.0] == kicks
    assert set(run.limits) == {(1.0,)}


def kicked_at(**options: Any) -> list[int]:
    """When an agent is kicked that costs 5.9 at first, and 9, 8, 7, 6, 5, 5, 5 ... after each noise."""
    last_noise: list[int] = []

    def settles(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        if step.policy_noise > 0.0 and update not in last_noise:
            last_noise.append(update)
        return 9.5, (max(5.0, 9.0 - (update - last_noise[-1])) if last_noise else 5.9,)

    run = play(settles, train=(5.0,), deploy=(5.0,), updates=100, episodes=lambda step: 2, **options)
    return [update for update, noise in enumerate(run.noise, start=1) if noise > 0.0]


def test_what_noise_does_to_the_costs_is_not_taken_for_being_stuck() -> None:
    assert kicked_at() == [10]


def test_literally_noise_follows_noise_for_ever() -> None:
    kicks = kicked_at(preset="paper", window=10)  # five updates of two episodes
    assert kicks[0] == 10
    assert len(kicks) > 10


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
    assert [group["history"] for group in run.state["groups"]] == [[]]
    for options in ({}, {"window": 80, "window_unit": "episodes"}):
        teacher = make_teacher(
            TeacherSpec("dynamic", options, CostLimits((250.0,)), CostLimits((5.0,)), train_steps=10**6)
        )
        _, state = teacher.start()
        for update in range(1, 50):
            episodes = (
                EpisodeStats(0, Phase.TRAINING, update, 1, 1.0, (9.0,), CostLimits((9.0,)), 0.0),
            ) * 30
            _, state = teacher.step(state, ProgressReport(update, update, episodes))
        assert all(len(group["history"]) <= 10 for group in state["groups"])


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
        (limit,), _ = decided(
            WindowStatistics(1, episodes, float(old), (9.0,), (0.0,), float(old_scatter)),
            WindowStatistics(1, episodes, float(new), (9.0,), (0.0,), float(new_scatter)),
            limits=(9.0,),
            deploy=(5.0,),
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


@pytest.mark.parametrize("unit", ["updates", "episodes"])
def test_no_decision_comes_from_fewer_than_ten_and_ten_episodes(unit: str, monkeypatch: Any) -> None:
    """With 4 x 64 steps an update and episodes of 1000, an update has a quarter of an episode."""
    compared: list[tuple[int, int]] = []

    def recorded(old: WindowStatistics, new: WindowStatistics, **keywords: Any) -> CurriculumStep:
        compared.append((old.episodes, new.episodes))
        return decide(old, new, **keywords)

    monkeypatch.setattr("recrl.teachers.dynamic.decide", recorded)
    generator = np.random.default_rng(2)
    spec = TeacherSpec(
        "dynamic", {"window": 5, "window_unit": unit}, CostLimits((200.0,)), CostLimits((25.0,)), 1_000_000
    )
    teacher = make_teacher(spec)
    step, state = teacher.start()
    for update in range(1, 2000):
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


def test_a_state_of_before_the_groups_goes_on() -> None:
    spec = TeacherSpec("dynamic", {}, CostLimits((50.0, 60.0)), CostLimits((5.0, 5.0)), 1000)
    teacher = make_teacher(spec)
    _, state = teacher.start()
    for update in range(1, 5):
        episode = EpisodeStats(0, Phase.TRAINING, update, 1, 9.5, (50.0, 60.0), CostLimits((50.0, 60.0)), 0.0)
        _, state = teacher.step(state, ProgressReport(update, update, (episode,)))
    shared = {key: value for key, value in state.items() if key not in ("groups", "longest")}
    record = [1, 1, 9.5, [50.0, 60.0], [0.0, 0.0], 0.0]
    earlier = {**shared, "last_change": 4, "history": [record] * 4}
    assert state["groups"][1]["history"] == [[1, 1, 9.5, [60.0], [0.0], 0.0]] * 4
    report = ProgressReport(5, 5, ())
    assert teacher.step(earlier, report) == teacher.step(state, report)


# Episodes that began before a change.


def long_episodes(
    teacher: DynamicTeacher, *, horizon: int, seed: int, short: float = 0.0
) -> tuple[int, int, list[float]]:
    """An agent that obeys each limit at once, in 64 environments with 64 steps an update.

    Each episode's cost scatters by a factor of its own; a step costs what the limit then in force allows.

    Args:
        teacher: the curriculum.
        horizon: steps of an episode.
        seed: of the costs.
        short: the share of episodes with 20 steps and without cost; the others cost more for it.

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
                        begin_step=end - int(lengths[env]) * envs,
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
    counted = teacher_of(overlapping_episodes="count")
    _, disturbed, _ = long_episodes(counted, horizon=1000, seed=seed)
    assert disturbed >= 4


def test_short_episodes_hardly_overlap_a_change() -> None:
    ignored, _, _ = long_episodes(teacher_of(), horizon=64, seed=0)
    counted, _, _ = long_episodes(teacher_of(overlapping_episodes="count"), horizon=64, seed=0)
    assert ignored == pytest.approx(counted, rel=0.1)


def test_no_episode_counts_that_ends_within_the_longest_one_after_a_change() -> None:
    teacher = teacher_of(100_000, window=1, window_grows=False)

    def reported(state: TeacherState, update: int, length: int, cost: float) -> Any:
        end = 1000 * update
        episode = EpisodeStats(
            0, Phase.TRAINING, end, 10, 9.5, (cost,), CostLimits((250.0,)), 0.0, begin_step=end - length
        )
        return teacher.step(state, ProgressReport(update, end, (episode,)))

    _, state = teacher.start()
    _, state = reported(state, 1, 500, 250.0)
    step, state = reported(state, 2, 1500, 250.0)
    assert step.limits[0] < 250.0
    assert state["groups"][0]["changed_at"] == 2000
    lowered = step.limits
    for length in (1500, 10):  # of before the change, and after it: a short one may be the cheap one
        ignored, unchanged = reported(state, 3, length, 0.0)
        assert (ignored.limits, ignored.policy_noise) == (lowered, 0.0)
    step, state = reported(unchanged, 4, 1500, lowered[0])
    assert (step.limits, step.policy_noise) == (lowered, 0.0)  # the older window has an episode of before
    step, state = reported(state, 5, 1500, lowered[0])
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
        steps_left(last, env_steps=0, train_steps=20_000, unit="windows", duration=duration)
        for duration in (0, 1000, 4000)
    ]
    assert left == [18, 8, 2]  # 20 - 2; (20 - 3) / 2; (20 - 6) / 5


@pytest.mark.parametrize("options", [{"window": 5}, {"window": 20, "window_unit": "episodes"}])
def test_the_remaining_episodes_are_those_to_come_though_some_do_not_count(options: dict[str, Any]) -> None:
    """64 environments of 64 steps an update, 1,000 steps an episode: 4 end per update, each at the limit."""
    budget = 1_900_000
    teacher = teacher_of(budget, remaining="episodes", overlapping_episodes="ignore", **options)
    step, state = teacher.start()
    steps_left_of = []
    for update in range(1, 200):
        begin, limit = 4096 * (update - 1), step.limits[0]
        ends = [begin + 64 * done for done in range(1, 5)] if update > 15 else []
        episodes = tuple(
            EpisodeStats(0, Phase.TRAINING, end, 1000, 10.0, (limit,), step.limits, 0.0, end - 64_000)
            for end in ends
        )
        step, state = teacher.step(state, ProgressReport(update, 4096 * update, episodes))
        if step.limits[0] != limit:
            divisor = (limit - 25.0) / (limit - step.limits[0])
            steps_left_of.append((divisor, (budget - 4096 * update) / 1024 - 1))
    assert len(steps_left_of) >= 5
    for divisor, episodes_to_come in steps_left_of:
        assert divisor == pytest.approx(episodes_to_come, rel=0.15)
