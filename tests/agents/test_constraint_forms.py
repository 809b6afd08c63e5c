"""The mean of the worst episodes: its estimate, its gradient, and agents that keep it within a limit."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

from recrl.agents.agent import Rollout
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.constraints.cost_measures import (
    MeanCost,
    TailCost,
    conditional_value_at_risk,
    tail_costs,
    value_at_risk,
)
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep, Floats
from recrl.environments.registry import make_vector

NUM_ENVS = 64


def column(*values: float) -> Floats:
    return np.array(values)[:, None]


def test_the_cvar_is_the_one_computed_by_hand() -> None:
    costs = np.array([[3.0, 0.0], [10.0, 0.0], [1.0, 0.0], [4.0, 0.0], [2.0, 8.0]])
    # The worst two of five; of the other cost the worst two are 8 and 0.
    assert conditional_value_at_risk(costs, 0.6).tolist() == pytest.approx([7.0, 4.0])
    assert value_at_risk(costs, 0.6).tolist() == [3.0, 0.0]
    # The worst one and a half: 10, and half of 4.
    assert conditional_value_at_risk(costs, 0.7).tolist() == pytest.approx([12.0 / 1.5, 8.0 / 1.5])


def test_at_level_0_the_cvar_is_the_mean_and_near_level_1_the_maximum() -> None:
    costs = np.random.default_rng(0).gamma(2.0, size=(37, 3))
    np.testing.assert_allclose(conditional_value_at_risk(costs, 0.0), costs.mean(axis=0))
    np.testing.assert_allclose(conditional_value_at_risk(costs, 0.99), costs.max(axis=0))


@pytest.mark.parametrize("level", [0.1, 0.5, 0.9])
def test_the_value_at_risk_is_numpys_quantile_and_minimises_the_cvars_formula(level: float) -> None:
    costs = np.random.default_rng(1).gamma(2.0, size=(50, 2))
    expected = np.quantile(costs, level, axis=0, method="inverted_cdf")
    np.testing.assert_array_equal(value_at_risk(costs, level), expected)
    least = [min(nu + np.maximum(each - nu, 0.0).mean() / (1.0 - level) for nu in each) for each in costs.T]
    np.testing.assert_allclose(conditional_value_at_risk(costs, level), least)


def test_only_cost_beyond_the_value_at_risk_counts() -> None:
    """One environment: two more steps of an episode that has cost 2, then a new one; nu = 3, alpha = 0.5."""
    found = tail_costs(
        column(0.5, 1.0, 2.0, 0.0, 2.0)[..., None],
        carried=np.array([[2.0]]),
        ended=np.array([[False], [True], [False], [False], [False]]),
        threshold=np.array([3.0]),
        level=0.5,
    )
    assert found.ravel().tolist() == [0.0, 1.0, 0.0, 0.0, 2.0]


def test_tail_costs_sum_to_what_an_episode_has_beyond_the_value_at_risk() -> None:
    collector = Collector(make_vector("two-state-2", 5), num_steps=7)
    collector.reset(seed=0)
    agent = make_agent("ppo", make_vector("two-state-2", 5).cmdp, {}, np.random.SeedSequence(0))
    generator = np.random.default_rng(0)
    threshold, sums, checked = np.array([2.0, 1.0]), np.zeros((5, 2)), 0
    for _ in range(6):
        rollout, episodes = collector.collect(agent, generator)
        ended = rollout.terminated | rollout.truncated
        found = tail_costs(
            rollout.costs, carried=rollout.carried_costs, ended=ended, threshold=threshold, level=0.8
        )
        finished = iter(episodes)
        for step, environment in itertools.product(range(7), range(5)):
            sums[environment] += found[step, environment]
            if ended[step, environment]:
                costs = np.array(next(finished).costs)
                np.testing.assert_allclose(sums[environment], np.maximum(costs - threshold, 0.0) / 0.2)
                sums[environment] = 0.0
                checked += 1
    assert checked == 20


def test_at_level_0_and_value_at_risk_0_tail_costs_are_costs() -> None:
    costs = np.random.default_rng(0).random((6, 3, 2))
    found = tail_costs(
        costs, carried=np.ones((3, 2)), ended=np.zeros((6, 3), bool), threshold=np.zeros(2), level=0.0
    )
    np.testing.assert_allclose(found, costs)


def rollout_of(costs: Floats) -> Rollout:
    """T steps of one environment with one cost, none of which ends an episode."""
    steps = len(costs)
    never, nothing = np.zeros((steps, 1), bool), np.zeros((0, 1), np.float32)
    return Rollout(
        observations=np.zeros((steps, 1, 1), np.float32),
        actions=np.zeros((steps, 1), np.int64),
        rewards=np.zeros((steps, 1)),
        costs=costs.reshape(steps, 1, 1),
        terminated=never,
        truncated=never,
        final_observations=nothing,
        last_observations=np.zeros((1, 1), np.float32),
        carried_costs=np.zeros((1, 1)),
        carried_lengths=np.zeros(1, np.int64),
    )


def test_without_a_finished_episode_the_value_at_risk_stays_and_nothing_is_known() -> None:
    form = TailCost(0.5, 1)
    limit = np.array([9.0])
    form.constraint_costs(rollout_of(np.zeros(1)), column(1.0, 2.0, 3.0), limit)
    costs, values = form.constraint_costs(rollout_of(np.array([1.0, 3.0])), np.empty((0, 1)), limit)
    assert costs.ravel().tolist() == [0.0, 4.0]
    assert math.isnan(values[0])
    resumed = TailCost(0.5, 1)
    resumed.load_state_dict(form.state_dict())
    found, _ = resumed.constraint_costs(rollout_of(np.array([1.0, 3.0])), np.empty((0, 1)), limit)
    assert found.ravel().tolist() == [0.0, 4.0]


def test_the_mean_form_leaves_costs_alone() -> None:
    rollout = rollout_of(np.array([1.0, 3.0]))
    limit = np.array([9.0])
    costs, values = MeanCost().constraint_costs(rollout, column(1.0, 2.0), limit)
    assert costs is rollout.costs
    assert values.tolist() == [1.5]
    assert math.isnan(MeanCost().constraint_costs(rollout, np.empty((0, 1)), limit)[1][0])


def test_where_the_limit_is_violated_all_cost_beyond_it_counts() -> None:
    """All episodes cost 9: the CVaR is flat; cost beyond the limit 5 is not, (9 - 5) / 0.25 beyond 5."""
    form = TailCost(0.75, 1)
    costs, values = form.constraint_costs(
        rollout_of(np.array([4.0, 3.0, 2.0])), column(9.0, 9.0), np.array([5.0])
    )
    assert costs.ravel().tolist() == [0.0, 8.0, 8.0]
    assert values.tolist() == [5.0 + 16.0]
    _, unlimited = form.constraint_costs(rollout_of(np.zeros(1)), column(9.0, 9.0), np.array([math.inf]))
    assert unlimited.tolist() == [9.0]


@pytest.mark.parametrize("limit", [0.5, 2.0, 4.0, 9.0])
def test_the_bound_is_within_the_limit_exactly_where_the_cvar_is(limit: float) -> None:
    generator = np.random.default_rng(0)
    for _ in range(50):
        costs = generator.gamma(1.0, 2.0, size=(20, 1))
        _, values = TailCost(0.7, 1).constraint_costs(rollout_of(np.zeros(1)), costs, np.array([limit]))
        exact = conditional_value_at_risk(costs, 0.7)
        assert values[0] >= exact[0]
        if exact[0] <= limit:
            assert values[0] == pytest.approx(exact[0])


def exact_cvar(hasty: float, level: float) -> float:
    """The CVaR of the wear of a stationary policy on ``two-state``, 9 steps in the mine: a binomial cost."""
    counts = np.arange(10)
    masses = stats.binom.pmf(counts, 9, hasty)
    return float(min(nu + masses @ np.maximum(counts - nu, 0.0) / (1.0 - level) for nu in counts))


def test_the_gradient_of_the_cvar_is_that_of_the_tail_costs() -> None:
    """The policy gradient of the tail costs, exact, against differences of the exact CVaR."""
    hasty, level, step = 0.37, 0.8, 1e-6
    sequences = np.array(list(itertools.product([0, 1], repeat=9)), dtype=np.float64)
    masses = np.prod(np.where(sequences > 0.0, hasty, 1.0 - hasty), axis=1)
    cumulative = stats.binom.cdf(np.arange(10), 9, hasty)
    threshold = np.array([float(np.argmax(cumulative >= level))])
    ended = np.zeros((9, len(sequences)), bool)
    tails = tail_costs(
        sequences.T[..., None],
        carried=np.zeros((len(sequences), 1)),
        ended=ended,
        threshold=threshold,
        level=level,
    )[..., 0]
    scores = np.where(sequences > 0.0, 1.0 / hasty, -1.0 / (1.0 - hasty)).T
    to_go = tails[::-1].cumsum(axis=0)[::-1]
    policy_gradient = float(masses @ (scores * to_go).sum(axis=0))
    difference = (exact_cvar(hasty + step, level) - exact_cvar(hasty - step, level)) / (2.0 * step)
    assert policy_gradient == pytest.approx(difference, rel=1e-6)


def last_third(agent_name: str, options: dict[str, Any], limit: float, updates: int) -> Floats:
    """The wear of an update's episodes, and their returns, in the last third of learning on ``two-state``.

    Returns:
        [updates, episodes, 2].
    """
    environments = make_vector("two-state", NUM_ENVS)
    agent = make_agent(agent_name, environments.cmdp, options, np.random.SeedSequence(0))
    collector = Collector(environments, num_steps=20)
    collector.reset(seed=0)
    generator = np.random.default_rng(0)
    kept: list[list[tuple[float, float]]] = []
    for update in range(updates):
        rollout, episodes = collector.collect(agent, generator)
        agent.update(rollout, episode_costs(episodes, 1), CurriculumStep(CostLimits((limit,))))
        if update >= updates * 2 / 3:
            kept.append([(episode.costs[0], episode.episode_return) for episode in episodes])
    return np.array(kept)


@pytest.mark.parametrize("agent", ["ppo-lag", "cpo"])
def test_a_student_finds_the_best_policy_whose_cvar_is_within_the_limit(agent: str) -> None:
    level, limit = 0.75, 5.0
    options = {"constraint": "cvar", "cvar_level": level, "cost_trace_decay": 1.0}
    outcome = last_third(agent, options, limit, 300 if agent == "ppo-lag" else 150)
    hasty = brentq(lambda share: exact_cvar(share, level) - limit, 0.01, 0.99)
    wear, returns = outcome[..., 0], outcome[..., 1]
    assert hasty * 9.0 < limit - 1.0  # a bound on the mean would allow much more
    assert float(wear.mean()) == pytest.approx(hasty * 9.0, abs=0.25)
    assert float(returns.mean()) == pytest.approx(9.0 + hasty * 9.0, abs=0.3)
    # Of each policy by itself: the CVaR of all their episodes together is that of a mixture, which has longer
    # tails the more the policies differ, and no policy's limit is on it.
    shares = np.clip(wear.mean(axis=1) / 9.0, 1e-3, 1.0 - 1e-3)
    assert np.mean([exact_cvar(share, level) for share in shares]) == pytest.approx(limit, abs=0.25)
