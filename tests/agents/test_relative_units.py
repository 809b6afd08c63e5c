"""Units in which the advantages of the reward and of every cost have the same spread, by hand."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from recrl.agents.agent import DiscretePolicy, Rollout
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.constraints.relative_units import RelativeConstraints, RelativeUnits
from recrl.agents.experience import Constraints, Experience
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CMDPSpec, CostLimits, CurriculumStep, Floats

# Spreads of the reward and of two costs: 4, 2 and 0; the third never occurred.
ADVANTAGES = np.array([[5.0, 7.0, 0.0, 1.0], [-3.0, 3.0, 0.0, 3.0]])

LIMITS = np.array([5.0, 5.0, 5.0])


def test_two_rollouts_by_hand() -> None:
    """The spreads are root mean squares over both rollouts: of the reward sqrt((16 + 1) / 2), of cost 0 2."""
    units = RelativeUnits(3)
    first = units.of(ADVANTAGES, LIMITS)
    assert first.rewards.tolist() == [1.0, -1.0]
    assert first.exchange_rates.tolist() == [2.0, 0.0, 4.0]
    assert first.costs[:, 0].tolist() == [1.0, -1.0]
    assert first.costs[:, 1].tolist() == [0.0, 0.0]
    resumed = RelativeUnits(3)
    resumed.load_state_dict(units.state_dict())
    second = np.array([[2.0, 7.0, 0.0, 1.0], [0.0, 3.0, 0.0, 3.0]])
    for each in (units, resumed):
        found = each.of(second, LIMITS)
        assert found.rewards.tolist() == [1.0, -1.0]
        assert found.exchange_rates[0] == pytest.approx(math.sqrt(8.5) / 2.0)
        # The reward's spread in this rollout is 1.
        assert found.factors[0] == pytest.approx(math.sqrt(8.5) / 2.0)
        assert found.costs[:, 0].tolist() == pytest.approx([math.sqrt(8.5), -math.sqrt(8.5)])


def constraints_of(limits: Floats, gaps: Floats) -> RelativeConstraints:
    policy = make_policy(1, Discrete(2), NetworkArchitecture((2,), orthogonal), 1.0, torch.Generator())
    batch = LearningBatch.deduplicate(np.zeros((2, 1), np.float32), np.array([0, 1]), compact=False)
    constraints = Constraints(limits, gaps, np.zeros(3), 10.0)
    return RelativeConstraints.of(Experience.of(policy, batch, ADVANTAGES, constraints), RelativeUnits(3))


def test_a_cost_can_bind_if_it_has_a_limit_and_has_occurred() -> None:
    """Gap 30 over 10 steps is 3 a step; cost 0 counts 2 / 4 of its unit, cost 2 4 / 4."""
    found = constraints_of(np.array([5.0, 5.0, 9.0]), np.array([30.0, -5.0, -2.0]))
    assert found.index.tolist() == [0, 2]
    assert found.violations.tolist() == pytest.approx([1.5, -0.2])
    assert found.costs.tolist() == [[1.0, -1.0], [-1.0, 1.0]]
    assert found.in_reward_per_cost(np.array([3.0, 5.0])).tolist() == [6.0, 0.0, 20.0]
    without_limit = constraints_of(np.array([math.inf, 5.0, 9.0]), np.array([-math.inf, -5.0, -2.0]))
    assert without_limit.index.tolist() == [2]


def test_before_any_reward_costs_count_in_their_own_spread() -> None:
    found = RelativeUnits(3).of(ADVANTAGES * np.array([0.0, 1.0, 1.0, 1.0]), LIMITS)
    assert found.rewards.tolist() == [0.0, 0.0]
    assert found.costs.tolist() == [[1.0, 0.0, -1.0], [-1.0, 0.0, 1.0]]
    assert found.exchange_rates.tolist() == [0.0, 0.0, 0.0]


def test_in_a_rollout_with_equal_rewards_costs_have_a_tenth_of_their_spread_as_unit() -> None:
    """The running spreads are sqrt((16 + 0) / 2) of the reward and 2 of cost 0; 1 / 0.1 is the cost's."""
    units = RelativeUnits(3)
    units.of(ADVANTAGES, LIMITS)
    found = units.of(ADVANTAGES * np.array([0.0, 1.0, 1.0, 1.0]), LIMITS)
    assert found.rewards.tolist() == [0.0, 0.0]
    assert found.exchange_rates.tolist() == pytest.approx([math.sqrt(8.0) / 2.0, 0.0, math.sqrt(8.0)])
    assert found.costs[:, 0].tolist() == pytest.approx([10.0, -10.0])
    assert found.costs[:, 2].tolist() == pytest.approx([-10.0, 10.0])


def test_a_cost_without_a_limit_does_not_scale_the_reward() -> None:
    units = RelativeUnits(3)
    units.of(ADVANTAGES, LIMITS)
    small = ADVANTAGES * np.array([0.01, 1.0, 1.0, 1.0])
    assert units.of(small, np.full(3, math.inf)).rewards.tolist() == pytest.approx([1.0, -1.0])
    assert units.of(small, LIMITS).rewards.max() < 0.2


def test_a_rollout_without_reward_does_not_stop_later_learning() -> None:
    """A bandit whose second arm pays and costs; after a rollout without reward the first one pays."""
    cmdp = CMDPSpec("bandit", Box(0.0, 1.0, (1,), np.float32), Discrete(2), ("cost",), 1)
    agent = make_agent("ppo-lag", cmdp, {"hidden_sizes": [8]}, np.random.SeedSequence(0))
    generator = np.random.default_rng(0)
    observations = np.ones((1, 256, 1), np.float32)
    for pays in [1.0] * 10 + [0.0] + [-1.0] * 30:
        actions = agent.act(observations[0], generator)
        costs = (actions == 1)[:, None].astype(np.float64)
        rewards = pays * costs[:, 0] + (0.3 * generator.normal(size=256) if pays else 0.0)
        rollout = Rollout(
            observations=observations,
            actions=actions[None],
            rewards=rewards[None],
            costs=costs[None],
            terminated=np.ones((1, 256), bool),
            truncated=np.zeros((1, 256), bool),
            final_observations=np.empty((0, 1), np.float32),
            last_observations=observations[0],
            carried_costs=np.zeros((256, 1)),
            carried_lengths=np.zeros(256, np.int64),
        )
        agent.update(rollout, costs, CurriculumStep(CostLimits((0.5,))))
    assert isinstance(agent, DiscretePolicy)
    assert agent.action_probabilities(observations[0, :1])[0, 1] < 0.25
