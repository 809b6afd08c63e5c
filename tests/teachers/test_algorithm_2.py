"""The preset paper is Algorithm 2: against the pseudocode, and where that is not defined."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.teachers.algorithm_2 import Algorithm2Teacher, episodes_left
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec
from recrl.teachers.windows import WindowStatistics
from tests.teachers.closed_loop import Agent, Run, noises, obedient, play, recovering


def paper(
    train: tuple[float, ...], deploy: tuple[float, ...], train_steps: int, **options: Any
) -> Algorithm2Teacher:
    spec = TeacherSpec(
        "dynamic", {"preset": "paper", **options}, CostLimits(train), CostLimits(deploy), train_steps
    )
    teacher = make_teacher(spec)
    assert isinstance(teacher, Algorithm2Teacher)
    return teacher


def episode(end: int, *costs: float, episode_return: float = 9.5) -> EpisodeStats:
    return EpisodeStats(0, Phase.TRAINING, end, 1, episode_return, costs, CostLimits(costs), 0.0)


def play_paper(agent: Agent, **settings: Any) -> Run:
    """A closed loop of Algorithm 2 with one episode an update, which is the paper's clock."""
    return play(agent, episodes=lambda step: 1, preset="paper", **settings)


def algorithm_2(
    returns: list[float],
    costs: list[tuple[float, ...]],
    *,
    train: tuple[float, ...],
    deploy: tuple[float, ...],
    window: int,
    tolerances: tuple[float, float],
) -> list[tuple[tuple[float, ...], bool]]:
    """The pseudocode of Algorithm 2, line by line: the limits and noise of every episode b.

    Args:
        returns: r(b) of the episodes 1, ..., B, above 0.
        costs: C(b) of these, each [k].
        train: d_t, [k].
        deploy: d_d, [k].
        window: W.
        tolerances: eps_r and eps_c.
    """
    budget, limits, last_change, taught = len(costs), train, 0, []  # line 2
    dimensions = range(len(train))
    for b in range(1, budget + 1):  # line 3
        noise = False
        if b > 2 * window and last_change >= window:  # line 4; at b = 2 W only 2 W - 1 are played
            starts = (b - 1 - window, b - 1 - 2 * window)
            new, old = (
                [math.fsum(c[i] for c in costs[start : start + window]) / window for i in dimensions]
                for start in starts
            )
            earned, before = (math.fsum(returns[start : start + window]) / window for start in starts)
            eps_r, eps_c = tolerances
            if abs(earned / before - 1.0) <= eps_r and all(
                abs(new[i] / old[i] - 1.0) <= eps_c for i in dimensions
            ):  # line 5
                if all(new[i] <= limits[i] for i in dimensions):  # line 6
                    # line 7; at b = B it divides by 0, and d_d is meant
                    part = 1.0 / (budget - b) if b < budget else 1.0
                    limits = tuple(max(deploy[i], new[i] - (new[i] - deploy[i]) * part) for i in dimensions)
                else:  # line 8
                    noise = True  # line 9
                last_change = 0  # line 11
        taught.append((limits, noise))  # line 14 plays under these
        last_change += 1  # line 15
    return taught


@pytest.mark.parametrize("num_costs", [1, 2])
@pytest.mark.parametrize("seed", range(8))
def test_the_preset_paper_is_algorithm_2_episode_by_episode(seed: int, num_costs: int) -> None:
    """Costs that stay, jump and fall, also below d_d, where nothing changes and line 11 resets."""
    generator = np.random.default_rng(seed)
    train, deploy = (60.0, 70.0)[:num_costs], (20.0, 30.0)[:num_costs]
    columns = []
    for _ in train:
        levels = np.concatenate([np.linspace(56.0, 30.0, 6), generator.uniform(2.0, 80.0, 8)])
        columns.append(
            [round(float(cost * generator.uniform(0.95, 1.05)), 3) for cost in np.repeat(levels, 25)]
        )
    costs = list(zip(*columns, strict=True))
    returns = np.repeat(generator.uniform(5.0, 15.0, len(costs) // 10), 10).tolist()  # often not converged
    expected = algorithm_2(returns, costs, train=train, deploy=deploy, window=5, tolerances=(0.2, 0.1))
    run = play_paper(
        lambda step, update: (returns[update - 1], costs[update - 1]),
        train=train,
        deploy=deploy,
        updates=len(costs),
        window=5,
        return_tolerance=0.2,
    )
    taught = [(train, False), *zip(run.limits, (noise > 0.0 for noise in run.noise), strict=True)]
    for (limits, noise), (literal, literal_noise) in zip(taught[:-1], expected, strict=True):
        assert limits == pytest.approx(literal, rel=1e-12)
        assert noise == literal_noise
    assert len({limits for limits, _ in expected}) > 3
    assert any(noise for _, noise in expected)


def test_the_steps_leave_an_ideal_agent_far_above_d_d() -> None:
    """Line 7 with B - b in episodes: from 250, the limit gets to about 158, by the product of its factors.

    Episode b = 21, 31, ... is the one about to be played when 20, 30, ... are.
    """
    run = play_paper(obedient, train=(250.0,), deploy=(25.0,), updates=1000, window=10)
    factors = [1.0 - 1.0 / (1000 - b) for b in range(21, 1000, 10)]
    assert run.limits[-2][0] == pytest.approx(25.0 + 225.0 * math.prod(factors))
    assert run.limits[-2][0] > 150.0
    assert run.limits[-1] == (25.0,)


def test_line_11_resets_the_clock_also_where_nothing_changes() -> None:
    """At d_d line 7 changes nothing, so a jump at episode 13 is answered one window after the last test."""

    def jumps(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        return 9.5, (5.0 if update <= 12 else 7.0,)

    run = play_paper(jumps, train=(5.0,), deploy=(5.0,), updates=60, window=4, cost_tolerance=0.5)
    assert next(update for update, noise in enumerate(run.noise, start=1) if noise > 0.0) == 16


def test_noise_follows_noise_for_ever() -> None:
    after = noises(recovering(), updates=100, preset="paper", window=10)  # five updates of two episodes
    assert after[0] == 10
    assert len(after) > 10


def test_all_limits_wait_for_the_last_cost() -> None:
    def limits_and_noise(*second: float) -> tuple[tuple[float, ...], float]:
        """After one episode in each update of costs 55 and these; W = 1, and six episodes are left."""
        teacher = paper((60.0, 30.0), (5.0, 5.0), len(second) + 6, window=1)
        _, state = teacher.start()
        for update, cost in enumerate(second, start=1):
            step, state = teacher.step(state, ProgressReport(update, update, (episode(update, 55.0, cost),)))
        return step.limits.values, step.policy_noise

    limits, noise = limits_and_noise(9.0, 9.0)
    assert limits == pytest.approx((45.0, 8.2))
    assert noise == 0.0
    assert limits_and_noise(9.0, 20.0) == ((60.0, 30.0), 0.0)
    assert limits_and_noise(40.0, 40.0) == ((60.0, 30.0), 0.3)


@pytest.mark.parametrize(("cost", "noise"), [(5.0, 0.0), (5.0 + 1e-12, 0.0), (5.01, 0.3)])
def test_a_mean_cost_may_not_exceed_its_limit(cost: float, noise: float) -> None:
    run = play_paper(lambda step, update: (9.5, (cost,)), train=(5.0,), deploy=(5.0,), updates=9, window=2)
    assert run.noise[3] == noise


def test_the_remaining_episodes_are_estimated_from_the_last_window() -> None:
    last = WindowStatistics(300, episodes=6, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,))
    assert episodes_left(last, env_steps=4000, train_steps=5000) == 19


def test_an_update_without_episodes_lends_its_steps_to_the_next() -> None:
    teacher = paper((9.0,), (5.0,), 10_000)
    _, state = teacher.start()
    for update, episodes in enumerate([(), (), (episode(300, 5.0),), ()], start=1):
        _, state = teacher.step(state, ProgressReport(update, 100 * update, episodes))
    assert [record[:2] for record in state["history"]] == [[300, 1], [100, 0]]


def test_the_state_stays_small() -> None:
    teacher = paper((250.0,), (5.0,), 10**6)
    _, state = teacher.start()
    for update in range(1, 50):
        _, state = teacher.step(state, ProgressReport(update, update, (episode(update, 9.0),) * 30))
    assert len(state["history"]) == 6  # two windows of 80 episodes


def test_a_measured_start_begins_the_clock() -> None:
    """The start is known after 10 of 100 updates; five updates, 80 episodes, later comes the first step."""
    run = play(
        lambda step, update: (9.5, (50.0,)),
        train=(math.inf,),
        deploy=(5.0,),
        updates=100,
        preset="paper",
        start_fraction=0.1,
    )
    assert run.limits[:14] == [(math.inf,)] * 9 + [(50.0,)] * 5
    assert run.limits[14][0] < 50.0


@pytest.mark.parametrize("name", ["return_floor", "cost_floor"])
def test_a_floor_is_refused(name: str) -> None:
    sentence = f"{name} has no effect with preset: paper: leave it out, got 0.5"
    with pytest.raises(ValidationError, match=sentence):
        paper((5.0,), (5.0,), 10, **{name: 0.5})
    paper((5.0,), (5.0,), 10, **{name: 0.0})  # as a trial records it
