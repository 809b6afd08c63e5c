"""The tiny CMDPs: their closed forms against the exact solver and against what their environments do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recrl.environments.cmdp import CostLimits
from recrl.environments.continuous_bandit import ContinuousBanditOptions, continuous_bandit_optimum
from recrl.environments.finite.exact_solver import evaluate_policy, solve_by_lagrangian
from recrl.environments.finite.two_state import (
    CAMP,
    MINE,
    TwoStateOptions,
    expected_steps_in_mine,
    two_state_cmdp,
    two_state_optimum,
)
from recrl.environments.registry import make_vector

options = st.builds(TwoStateOptions, horizon=st.integers(2, 15), arrival=st.floats(0.1, 1.0))


@given(options, st.floats(0.0, 20.0))
def test_the_closed_form_is_the_exact_optimum_for_one_cost(options: TwoStateOptions, wear: float) -> None:
    limits = CostLimits((wear,))
    exact = solve_by_lagrangian(two_state_cmdp(options, 1), limits).episode_return
    assert two_state_optimum("two-state", options, limits) == pytest.approx(exact, abs=1e-6)


@given(options, st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_the_closed_form_is_the_exact_optimum_for_two_costs(
    options: TwoStateOptions, wear: float, noise: float
) -> None:
    limits = CostLimits((wear, noise))
    exact = solve_by_lagrangian(two_state_cmdp(options, 2), limits).episode_return
    assert two_state_optimum("two-state-2", options, limits) == pytest.approx(exact, abs=1e-6)


@given(options, st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_a_stationary_policy_reaches_the_optimum_with_both_constraints_binding(
    options: TwoStateOptions, wear: float, noise: float
) -> None:
    mine = expected_steps_in_mine(options)
    reckless = min(wear, noise, mine) / mine
    hasty = min(wear, mine) / mine - reckless
    policy = np.zeros((2, 3))
    policy[CAMP, 1] = 1.0
    policy[MINE] = [1.0 - hasty - reckless, hasty, reckless]
    value = evaluate_policy(two_state_cmdp(options, 2), policy)
    limits = CostLimits((wear, noise))
    assert value.episode_return == pytest.approx(two_state_optimum("two-state-2", options, limits))
    np.testing.assert_allclose(value.costs, [min(wear, mine), min(wear, noise, mine)], atol=1e-9)


def test_an_episode_counted_by_hand() -> None:
    environment = make_vector("two-state", 1, options={"horizon": 4})
    environment.reset(seed=0)
    rewards, costs, seen = [], [], []
    for action in (0, 1, 0, 1):  # wait, go, careful, hasty
        observations, reward, _, truncated, info = environment.step(np.array([action]))
        rewards.append(reward[0])
        costs.append(info["cost"][0, 0])
        seen.append(observations[0].tolist())
    assert rewards == [0.0, 0.0, 1.0, 2.0]
    assert costs == [0.0, 0.0, 0.0, 1.0]
    assert seen == [[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 0.0]]
    assert truncated[0]
    assert info["final_obs"].tolist() == [[0.0, 1.0]]


def test_the_way_to_the_mine_arrives_with_the_stated_probability() -> None:
    environment = make_vector("two-state", 10_000, options={"arrival": 0.3})
    environment.reset(seed=0)
    observations, *_ = environment.step(np.ones(10_000, np.int64))
    assert observations[:, MINE].mean() == pytest.approx(0.3, abs=0.015)  # 3 standard errors


@pytest.mark.parametrize(
    ("limit", "action", "optimum"), [(0.0, 0.0, 0.0), (2.5, 0.5, 7.5), (40.0, 1.0, 10.0)]
)
def test_the_bandits_best_action_earns_the_optimum_at_the_limit(
    limit: float, action: float, optimum: float
) -> None:
    environment = make_vector("continuous-bandit", 1)
    environment.reset(seed=0)
    steps = [environment.step(np.array([[action]], np.float32)) for _ in range(10)]
    assert continuous_bandit_optimum("", ContinuousBanditOptions(), CostLimits((limit,))) == optimum
    assert sum(step[1][0] for step in steps) == pytest.approx(optimum)
    assert sum(step[4]["cost"][0, 0] for step in steps) == pytest.approx(min(limit, 10.0))
    assert [bool(step[3][0]) for step in steps] == [False] * 9 + [True]


def test_the_bandit_clips_actions_to_its_bounds() -> None:
    environment = make_vector("continuous-bandit", 2)
    environment.reset(seed=0)
    _, rewards, _, _, info = environment.step(np.array([[7.0], [-7.0]], np.float32))
    assert rewards.tolist() == [1.0, -3.0]
    assert info["cost"].tolist() == [[1.0], [1.0]]
