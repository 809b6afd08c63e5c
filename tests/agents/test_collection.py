"""Collecting: what a rollout holds, whole episodes across rollouts, exact resume."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary

from recrl.agents.agent import DiscretePolicy
from recrl.agents.collection import Collector, FinishedEpisode, episode_costs
from recrl.agents.errors import UnsupportedSpaceError
from recrl.agents.registry import make_agent
from recrl.agents.spaces import (
    action_range,
    action_size,
    environment_actions,
    observation_rows,
    observation_size,
    unbounded_numbers,
)
from recrl.environments.registry import make_vector

CAMP, MINE = [1.0, 0.0], [0.0, 1.0]


class Constantly:
    """A policy that always does the same."""

    def __init__(self, action: Any) -> None:
        self.action = np.asarray(action)

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        return np.repeat(self.action[None], len(observations), axis=0)


class Randomly:
    """A policy that does anything."""

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        return generator.integers(2, size=len(observations))


def collector_of(task: str, *, num_envs: int, num_steps: int, horizon: int = 4) -> Collector:
    environments = make_vector(task, num_envs, options={"horizon": horizon})
    collector = Collector(environments, num_steps=num_steps)
    collector.reset(seed=3)
    return collector


def test_a_rollout_holds_what_happened() -> None:
    """Always hasty: to the mine at once, then reward 2 and cost 1 a step until the time-out after 4 steps."""
    collector = collector_of("two-state", num_envs=2, num_steps=6)
    rollout, episodes = collector.collect(Constantly(1), np.random.default_rng(0))
    assert rollout.observations[:, 0].tolist() == [CAMP, MINE, MINE, MINE, CAMP, MINE]
    assert rollout.actions.tolist() == [[1, 1]] * 6
    assert rollout.rewards[:, 0].tolist() == [0.0, 2.0, 2.0, 2.0, 0.0, 2.0]
    assert rollout.costs[:, 0].tolist() == [[0.0], [1.0], [1.0], [1.0], [0.0], [1.0]]
    assert not rollout.terminated.any()
    assert rollout.truncated[:, 0].tolist() == [False, False, False, True, False, False]
    assert rollout.final_observations.tolist() == [MINE, MINE]
    assert rollout.last_observations.tolist() == [MINE, MINE]
    assert rollout.observations.dtype == rollout.final_observations.dtype == np.float32
    assert episodes == (FinishedEpisode(3, 0, 4, 6.0, (3.0,)), FinishedEpisode(3, 1, 4, 6.0, (3.0,)))


def test_costs_of_a_batch_must_have_a_column_for_each_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    environments = make_vector("two-state-2", 3)
    step = environments.step

    def with_one_cost(actions: Any) -> Any:
        *rest, info = step(actions)
        return *rest, {**info, "cost": info["cost"][:, :1]}

    monkeypatch.setattr(environments, "step", with_one_cost)
    collector = Collector(environments, num_steps=2)
    collector.reset(seed=0)
    with pytest.raises(ValueError, match=r"a column for each of 2 costs, got the shape \(3, 1\)$"):
        collector.collect(Constantly(1), np.random.default_rng(0))


def test_an_episode_goes_on_across_rollouts() -> None:
    collector = collector_of("two-state-2", num_envs=1, num_steps=3)
    policy, generator = Constantly(2), np.random.default_rng(0)
    assert collector.collect(policy, generator)[1] == ()
    _, episodes = collector.collect(policy, generator)
    assert episodes == (FinishedEpisode(0, 0, 4, 9.0, (3.0, 3.0)),)


def test_one_long_rollout_is_two_short_ones() -> None:
    long, _ = collector_of("two-state", num_envs=3, num_steps=10).collect(
        Randomly(), np.random.default_rng(0)
    )
    collector, generator = collector_of("two-state", num_envs=3, num_steps=5), np.random.default_rng(0)
    first, _ = collector.collect(Randomly(), generator)
    second, _ = collector.collect(Randomly(), generator)
    for name in ("observations", "actions", "rewards", "costs", "truncated"):
        both = np.concatenate([getattr(first, name), getattr(second, name)])
        np.testing.assert_array_equal(both, getattr(long, name))


def test_a_resumed_collector_continues_exactly() -> None:
    environments = make_vector("two-state", 3, options={"horizon": 4})
    collector, generator = Collector(environments, num_steps=3), np.random.default_rng(0)
    collector.reset(seed=1)
    collector.collect(Randomly(), generator)
    saved = (collector.state_dict(), environments.state_dict(), generator.bit_generator.state)
    expected, expected_episodes = collector.collect(Randomly(), generator)

    again = make_vector("two-state", 3, options={"horizon": 4})
    resumed, generator = Collector(again, num_steps=3), np.random.default_rng(99)
    resumed.load_state_dict(saved[0])
    again.reset(seed=0)
    again.load_state_dict(saved[1])
    generator.bit_generator.state = saved[2]
    found, episodes = resumed.collect(Randomly(), generator)
    assert episodes == expected_episodes
    np.testing.assert_array_equal(found.observations, expected.observations)
    np.testing.assert_array_equal(found.rewards, expected.rewards)


def test_an_agent_acts_by_inversion() -> None:
    environments = make_vector("rivergrid-1a", 4)
    agent = make_agent("ppo", environments.cmdp, {}, np.random.SeedSequence(0))
    observations, _ = environments.reset(seed=0)
    assert isinstance(agent, DiscretePolicy)
    cumulative = agent.action_probabilities(observations).cumsum(axis=1)
    draws = np.random.default_rng(1).random(4)
    expected = [
        int(np.searchsorted(row, draw, side="right")) for row, draw in zip(cumulative, draws, strict=True)
    ]
    assert agent.act(observations, np.random.default_rng(1)).tolist() == expected


def test_gaussian_actions_are_clipped_for_the_task_and_kept_for_the_agent() -> None:
    collector = collector_of("continuous-bandit", num_envs=1, num_steps=1)
    rollout, _ = collector.collect(Constantly(np.array([3.0], np.float32)), np.random.default_rng(0))
    assert rollout.actions.tolist() == [[[3.0]]]
    assert rollout.costs.tolist() == [[[1.0]]]  # 1 squared, not 3


def test_nothing_is_collected_before_a_reset() -> None:
    collector = Collector(make_vector("two-state", 1), num_steps=1)
    with pytest.raises(RuntimeError, match="a collector must be reset or restored before it collects"):
        collector.collect(Randomly(), np.random.default_rng(0))
    with pytest.raises(ValueError, match="num_steps must be at least 1, got 0"):
        Collector(make_vector("two-state", 1), num_steps=0)


def test_the_state_of_other_environments_is_refused() -> None:
    state = collector_of("two-state", num_envs=2, num_steps=1).state_dict()
    with pytest.raises(ValueError, match="have the shape"):
        collector_of("two-state", num_envs=3, num_steps=1).load_state_dict(state)


def test_episode_costs_of_no_episode_have_a_shape() -> None:
    assert episode_costs((), 2).shape == (0, 2)
    assert episode_costs((FinishedEpisode(0, 0, 1, 0.0, (1.0, 2.0)),), 2).tolist() == [[1.0, 2.0]]


def test_observations_of_every_supported_space_become_rows() -> None:
    assert observation_rows(Discrete(3, start=1), np.array([1, 3])).tolist() == [[1, 0, 0], [0, 0, 1]]
    box = Box(0.0, 1.0, (2, 2))
    assert observation_size(box) == 4
    assert observation_rows(box, np.zeros((3, 2, 2))).shape == (3, 4)
    assert observation_rows(MultiBinary(2), np.array([[1, 0]], np.int8)).tolist() == [[1.0, 0.0]]


def test_a_space_that_no_agent_handles_is_refused() -> None:
    with pytest.raises(UnsupportedSpaceError, match="observation space must be Discrete, Box or MultiBinary"):
        observation_size(Dict({}))
    with pytest.raises(UnsupportedSpaceError, match="action space must be Discrete or a Box of floats"):
        action_size(MultiBinary(2))


@pytest.mark.parametrize(
    ("low", "high", "action", "expected"),
    [
        (-1.0, 1.0, 0.25, 0.25),
        (10.0, 20.0, 0.4, 17.0),
        (10.0, 20.0, -3.0, 10.0),
        (-np.inf, np.inf, -3.0, -3.0),
        (0.0, np.inf, 3.0, 4.0),
        (0.0, np.inf, -3.0, 0.0),
        (5.0, np.inf, 0.0, 6.0),
        (5.0, np.inf, -0.5, 5.5),
        (-np.inf, 5.0, 0.0, 4.0),
        (-np.inf, 5.0, 0.5, 4.5),
        (-np.inf, 5.0, 3.0, 5.0),
        (np.finfo(np.float32).min, np.finfo(np.float32).max, 2.0, 2.0),
    ],
)
def test_continuous_actions_are_in_half_ranges_from_the_middle(
    low: float, high: float, action: float, expected: float
) -> None:
    space = Box(low, high, (1, 1), np.float32)
    assert environment_actions(space, np.array([[action]], np.float32)).tolist() == [[[expected]]]


def test_discrete_actions_are_shifted_to_the_first() -> None:
    assert environment_actions(Discrete(2, start=5), np.array([0, 1])).tolist() == [5, 6]


def test_a_rollout_says_what_its_first_episodes_have_cost_before() -> None:
    """Always hasty: no cost in the camp, 1 a step in the mine, a time-out after 4 steps."""
    collector = collector_of("two-state", num_envs=2, num_steps=3)
    policy, generator = Constantly(1), np.random.default_rng(0)
    carried = [collector.collect(policy, generator)[0].carried_costs.tolist() for _ in range(3)]
    assert carried == [[[0.0], [0.0]], [[2.0], [2.0]], [[1.0], [1.0]]]


@pytest.mark.parametrize("bound", [np.inf, np.finfo(np.float32).max, 1e30])
def test_a_bound_of_a_types_size_is_none(bound: float) -> None:
    space = Box(np.array([0.0, -bound, 0.0], np.float32), np.array([1.0, 1.0, bound], np.float32))
    assert unbounded_numbers(space).tolist() == [False, True, True]
    middle, half = action_range(space)
    assert (middle.tolist(), half.tolist()) == ([0.5, 0.0, 1.0], [0.5, 1.0, 1.0])
