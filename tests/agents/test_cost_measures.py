"""The mean of the worst episodes: its estimate, its gradient, and agents that keep it within a limit."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats
from scipy.optimize import brentq

from recrl.agents.agent import Rollout
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.constraints.cost_measures import (
    Episodes,
    MeanCost,
    RecentEpisodes,
    TailCost,
    tail_bound,
    tail_costs,
    value_at_risk,
)
from recrl.agents.constraints.life_table import LifeTable
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep, Floats
from recrl.environments.registry import make_vector

NUM_ENVS = 64


def conditional_value_at_risk(costs: Floats, level: float) -> Floats:
    return tail_bound(costs, value_at_risk(costs, level), level)


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


def rollout_of(costs: Floats, age: int | npt.NDArray[np.int64] = 0, ended: npt.ArrayLike = False) -> Rollout:
    """Steps with one cost, [T] or [T, B], in episodes that had ``age`` steps before; ``ended`` [T, B]."""
    costs = costs.reshape(len(costs), -1, 1)
    shape = costs.shape[:2]
    never, nothing = np.zeros(shape, bool), np.zeros((0, 1), np.float32)
    return Rollout(
        observations=np.zeros((*shape, 1), np.float32),
        actions=np.zeros(shape, np.int64),
        rewards=np.zeros(shape),
        costs=costs,
        terminated=never | np.array(ended, bool),
        truncated=never,
        final_observations=nothing,
        last_observations=np.zeros((shape[1], 1), np.float32),
        carried_costs=np.zeros((shape[1], 1)),
        carried_lengths=np.full(shape[1], age),
    )


def episodes_of(*costs: float, finished: int | None = None, length: int = 10) -> Episodes:
    """Episodes of one cost and one length, of which the last ``finished`` are new."""
    return Episodes(
        column(*costs),
        np.full(len(costs), length),
        finished=len(costs) if finished is None else finished,
    )


NONE = Episodes(np.empty((0, 1)), np.empty(0, np.int64), finished=0)


@pytest.mark.parametrize("finished", [0, 1, 3])
def test_the_worst_episodes_are_those_of_the_window_whichever_of_them_are_new(finished: int) -> None:
    """The value at risk of 1, 2, 3 at level 0.5 is 2: the CVaR is 2 + (1 / 3) / 0.5."""
    episodes = episodes_of(1.0, 2.0, 3.0, finished=finished)
    found = TailCost(0.5).measure(rollout_of(np.array([1.0, 3.0])), episodes, np.array([9.0]))
    assert found.step_costs.ravel().tolist() == [0.0, 4.0]
    assert found.values.tolist() == pytest.approx([2.0 + 2.0 / 3.0])


def test_before_a_first_episode_has_finished_those_under_way_count() -> None:
    """They cost 4 and 6 so far, so the worst half costs 6: 2 beyond 4, the value at risk at level 0.5."""
    rollout = rollout_of(np.array([[1.0, 3.0], [3.0, 3.0]]))
    found = TailCost(0.5).measure(rollout, NONE, np.array([9.0]))
    assert found.values.tolist() == [6.0]
    assert found.step_costs[..., 0].tolist() == [[0.0, 0.0], [0.0, 4.0]]
    assert found.standard_errors.tolist() == [2.0]
    assert found.episode_length == 2.0


def test_the_standard_error_is_that_of_the_constrained_value() -> None:
    """The spread of many estimates of one CVaR, and the mean of the reported standard errors."""
    generator, level, found = np.random.default_rng(0), 0.9, list[tuple[float, float]]()
    for _ in range(2_000):
        costs = generator.exponential(5.0, size=(200, 1))
        episodes = Episodes(costs, np.ones(200, np.int64), finished=200)
        each = TailCost(level).measure(rollout_of(np.zeros(1)), episodes, np.array([math.inf]))
        found.append((each.values[0], each.standard_errors[0]))
    values, errors = np.array(found).T
    assert errors.mean() == pytest.approx(values.std(), rel=0.1)
    assert np.mean(values) == pytest.approx(5.0 * (1.0 + math.log(10.0)), rel=0.03)


def test_the_mean_is_that_of_the_episodes_where_enough_finished() -> None:
    rollout = rollout_of(np.array([[1.0, 1.0], [3.0, 3.0]]))
    found = MeanCost(2, 1).measure(rollout, episodes_of(1.0, 3.0), np.array([9.0]))
    assert found.step_costs is rollout.costs
    assert (found.values.tolist(), found.standard_errors.tolist()) == ([2.0], [1.0])
    assert found.episode_length == 10.0


def test_where_few_episodes_finished_the_mean_is_that_of_the_steps() -> None:
    """Steps of age 0 cost 0 and 1, of age 1 then 1 and 2: 0.5 + 1.5 an episode; 96 to 100 long ago.

    Those have a standard deviation of 2, and there are two steps of each age.
    """
    rollout = rollout_of(np.array([[0.0, 1.0], [1.0, 2.0]]))
    for finished in (0, 1):
        found = MeanCost(2, 1).measure(
            rollout, episodes_of(96.0, 98.0, 100.0, finished=finished), np.array([9.0])
        )
        assert (found.values.tolist(), found.episode_length) == ([2.0], 2.0)
        assert found.standard_errors.tolist() == pytest.approx([2.0 / math.sqrt(2.0)])


def test_a_cost_that_no_recent_and_no_running_episode_has_is_0_exactly() -> None:
    """The life table alone would only approach 0."""
    mean, none = MeanCost(4, 1), np.zeros((2, 1))
    assert mean.measure(rollout_of(np.ones((2, 1))), NONE, np.zeros(1)).values.tolist() == [2.0]
    running = replace(rollout_of(none), carried_costs=np.ones((1, 1)))
    assert mean.measure(running, NONE, np.zeros(1)).values.tolist() == [1.0]
    assert mean.measure(rollout_of(none), episodes_of(1.0, finished=0), np.zeros(1)).values[0] > 0.5
    assert mean.measure(rollout_of(none), episodes_of(0.0, finished=0), np.zeros(1)).values.tolist() == [0.0]


def test_a_life_table_by_hand() -> None:
    """Ages 0 to 2: of two steps each none, one and one end an episode; of age 1 they cost 2, of age 2 4.

    So an episode reaches the ages with probability 1, 1 and 1/2, costs 2 + 4 / 2 and lasts 2.5 steps.
    """
    table = LifeTable(2, 1)
    costs = np.array([[0.0, 0.0], [2.0, 2.0], [0.0, 4.0], [0.0, 4.0]])
    table.add(rollout_of(costs[:2], ended=[[False, False], [True, False]]))
    # The first environment is at age 0 again, the second at age 2, and the next time, too.
    table.add(rollout_of(costs[2:3], age=np.array([0, 2]), ended=[[False, True]]))
    table.add(rollout_of(costs[3:], age=np.array([0, 2]), ended=[[False, False]]))
    found = table.means()
    assert (found.costs.tolist(), found.length) == ([4.0], 2.5)
    assert found.number == pytest.approx(2.0)


def test_a_life_table_of_two_costs() -> None:
    """At ages 0 and 1 two environments cost (1 + 3) / 2 + (2 + 4) / 2, of the second cost ten times that."""
    first = rollout_of(np.array([[1.0, 3.0], [2.0, 4.0]]))
    table = LifeTable(1, 2)
    table.add(replace(first, costs=np.concatenate([first.costs, 10.0 * first.costs], axis=-1)))
    assert table.means().costs.tolist() == [5.0, 50.0]


def test_older_steps_of_an_age_count_as_far_as_the_newest_rollout_lacks_steps() -> None:
    """Four steps cost 1, then three cost 5: with a window of 4 one of the older ones counts, (1 + 15) / 4.

    Of two more that cost 9, the mean of all earlier ones counts 2: (8 + 18) / 4.
    """
    table = LifeTable(4, 1)
    table.add(rollout_of(np.full((1, 4), 1.0)))
    table.add(rollout_of(np.full((1, 3), 5.0)))
    assert table.means().costs.tolist() == [4.0]
    table.add(rollout_of(np.full((1, 2), 9.0)))
    resumed = LifeTable(4, 1)
    resumed.load_state_dict(table.state_dict())
    for each in (table, resumed):
        assert each.means().costs.tolist() == [6.5]
        each.add(rollout_of(np.full((1, 5), 7.0)))
        found = each.means()
        assert found.costs.tolist() == [7.0]
        assert found.number == pytest.approx(5.0)


def test_until_an_episode_has_finished_the_mean_is_that_of_its_first_steps() -> None:
    found = MeanCost(1, 1).measure(rollout_of(np.ones(3)), NONE, np.array([9.0]))
    assert (found.values.tolist(), found.standard_errors.tolist()) == ([3.0], [0.0])
    assert found.episode_length == 3.0


@pytest.mark.parametrize("lengths", ["alike", "two", "random", "full"])
def test_the_life_table_is_right_whether_or_not_the_environments_are_synchronised(lengths: str) -> None:
    """Only the last 20 steps of an episode cost 1 each; of random lengths, each step by chance.

    In rollouts of 16 steps, synchronised environments have such a cost in few of them.
    """
    generator = np.random.default_rng(0)

    def draw(count: int) -> npt.NDArray[np.int64]:
        if lengths == "alike":
            return generator.integers(98, 103, count)
        if lengths == "two":
            return np.where(generator.random(count) < 0.5, 60, 250)
        return generator.geometric(0.02, count) if lengths == "random" else np.full(count, 250)

    table, ends = LifeTable(16, 1), draw(64)
    ages = np.arange(64) * 4 if lengths == "full" else np.zeros(64, np.int64)
    ages %= ends
    so_far, truths, found = np.zeros(64), list[float](), list[float]()
    for update in range(200):
        costs, ended, before = np.zeros((16, 64)), np.zeros((16, 64), bool), ages.copy()
        for step in range(16):
            costs[step] = generator.random(64) < 0.3 if lengths == "random" else ages >= ends - 20
            so_far, ages = so_far + costs[step], ages + 1
            ended[step] = ages >= ends
            if update > 20:
                truths += so_far[ended[step]].tolist()
            so_far[ended[step]], ages[ended[step]] = 0.0, 0
            ends[ended[step]] = draw(int(ended[step].sum()))
        table.add(rollout_of(costs, age=before, ended=ended))
        if update > 40:
            found.append(table.means().costs[0])
    assert np.mean(found) == pytest.approx(np.mean(truths), rel=0.05)
    assert np.std(found) < 0.25 * np.mean(truths)


def test_the_window_has_the_newest_update_and_earlier_ones_until_it_is_full() -> None:
    window = RecentEpisodes(3, 1)
    window.add(column(1.0, 2.0), np.array([1, 2]))
    window.add(column(3.0, 4.0), np.array([3, 4]))
    found = window.add(np.empty((0, 1)), np.empty(0, np.int64))
    assert (found.costs.ravel().tolist(), found.finished) == ([1.0, 2.0, 3.0, 4.0], 0)
    resumed = RecentEpisodes(3, 1)
    resumed.load_state_dict(window.state_dict())
    for each in (window, resumed):
        found = each.add(column(5.0), np.array([5]))
        assert found.costs.ravel().tolist() == [3.0, 4.0, 5.0]
        assert (found.lengths.tolist(), found.finished) == ([3, 4, 5], 1)


def test_where_the_limit_is_violated_all_cost_beyond_it_counts() -> None:
    """All episodes cost 9: the CVaR is flat; cost beyond the limit 5 is not, (9 - 5) / 0.25 beyond 5."""
    form = TailCost(0.75)
    found = form.measure(rollout_of(np.array([4.0, 3.0, 2.0])), episodes_of(9.0, 9.0), np.array([5.0]))
    assert found.step_costs.ravel().tolist() == [0.0, 8.0, 8.0]
    assert found.values.tolist() == [5.0 + 16.0]
    unlimited = form.measure(rollout_of(np.zeros(1)), episodes_of(9.0, 9.0), np.array([math.inf]))
    assert unlimited.values.tolist() == [9.0]


@pytest.mark.parametrize("limit", [0.5, 2.0, 4.0, 9.0])
def test_the_bound_is_within_the_limit_exactly_where_the_cvar_is(limit: float) -> None:
    generator = np.random.default_rng(0)
    for _ in range(50):
        costs = generator.gamma(1.0, 2.0, size=(20, 1))
        episodes = Episodes(costs, np.ones(20, np.int64), finished=20)
        values = TailCost(0.7).measure(rollout_of(np.zeros(1)), episodes, np.array([limit])).values
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
def test_an_agent_finds_the_best_policy_whose_cvar_is_within_the_limit(agent: str) -> None:
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
