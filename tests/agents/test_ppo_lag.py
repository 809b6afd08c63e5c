"""PPO-Lagrangian's own rules: multipliers, scaling, and what the policy climbs."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete

from recrl.agents.algorithms.own_options import PPOLagConfig
from recrl.agents.algorithms.ppo_lag import SURROGATE_OBJECTIVES, PPOLagrangian
from recrl.agents.building_blocks.advantages import standardised_rewards
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.constraints.cost_measures import MeasuredCosts
from recrl.agents.experience import Constraints, Experience
from recrl.agents.learning.policy_rule import improve_and_measure
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal

STATES = np.array([0, 0, 1, 1, 1, 2])
ACTIONS = np.array([0, 1, 0, 1, 1, 0])
ADVANTAGES = np.array([[1.0, 2.0], [-1.0, 0.0], [2.0, 1.0], [0.0, 0.0], [-3.0, 1.0], [1.0, 2.0]])
EXCHANGE = float(ADVANTAGES[:, 0].std() / ADVANTAGES[:, 1].std())


def measured(gap: float, limit: float = 5.0) -> Constraints:
    return Constraints(np.array([limit]), np.array([gap]), np.zeros(1), 10.0)


def fresh(**options: object) -> tuple[StochasticPolicy, PPOLagrangian, LearningBatch]:
    generator = torch.Generator().manual_seed(0)
    policy = make_policy(3, Discrete(2), NetworkArchitecture((8,), orthogonal), 1.0, generator)
    rule = PPOLagrangian(PPOLagConfig.model_validate(options), policy, 1)
    return policy, rule, LearningBatch.deduplicate(np.eye(3, dtype=np.float32)[STATES], ACTIONS, compact=True)


def improvement(
    rule: PPOLagrangian, policy: StochasticPolicy, batch: LearningBatch, constraints: Constraints
) -> dict[str, float]:
    experience = Experience.of(policy, batch, ADVANTAGES, constraints)
    return improve_and_measure(rule, policy, experience, np.random.default_rng(0))


def improved(gap: float, limit: float = 5.0, **options: object) -> dict[str, float]:
    policy, rule, batch = fresh(**options)
    return improvement(rule, policy, batch, measured(gap, limit))


def test_the_multiplier_answers_before_the_policy_moves() -> None:
    found = improved(10.0, multiplier_rule="projected", multiplier_step=0.02, multiplier_unit="cost")
    assert found["multiplier_0"] == 0.2


@pytest.mark.parametrize("rule", ["projected", "proportional-integral"])
def test_equal_shares_of_the_limit_have_equal_multipliers_whatever_the_limit(rule: str) -> None:
    without_proportion = {"multiplier_proportional": 0.0} if rule == "proportional-integral" else {}
    options = {"multiplier_rule": rule, "multiplier_step": 0.02, **without_proportion}
    found = [improved(share * 2.0, share, **options)["multiplier_0"] for share in (1.0, 5.0, 25.0)]
    # Twice the limit too much; the integral sums up one limit at most.
    assert found == pytest.approx([0.04 * EXCHANGE if rule == "projected" else 0.02 * EXCHANGE] * 3)


def test_a_pid_answers_half_a_limit_too_much_with_half_its_gain() -> None:
    assert improved(2.5, 5.0)["multiplier_0"] == pytest.approx((0.5 * 1.0 + 0.5 * 0.1) * EXCHANGE)


@pytest.mark.parametrize("rule", ["projected", "softplus-adam", "proportional-integral"])
def test_no_limit_is_no_penalty(rule: str) -> None:
    metrics = improved(-math.inf, math.inf, multiplier_rule=rule, multiplier_initial=2.0)
    assert metrics["multiplier_0"] == 0.0


def test_rewards_are_standardised() -> None:
    assert standardised_rewards(np.array([[1.0, 4.0], [5.0, 10.0]])).tolist() == [-1.0, 1.0]


def test_equal_rewards_are_no_division_by_zero() -> None:
    assert standardised_rewards(np.array([[1.0, 0.0], [1.0, 1.0]])).tolist() == [0.0, 0.0]


def test_a_policy_that_has_not_moved_has_ratio_one() -> None:
    metrics = improved(0.0, policy_steps=1, policy_learning_rate=1e-30)
    assert metrics["surrogate_reward"] == pytest.approx(0.0, abs=1e-7)


def test_the_policy_stops_when_it_has_moved_too_far() -> None:
    metrics = improved(0.0, policy_learning_rate=0.05, policy_steps=40, target_kl=1e-4)
    assert 1.0 <= metrics["policy_steps"] < 40.0


def test_the_policy_climbs_the_penalised_advantages() -> None:
    gain = improved(0.0)
    assert gain["surrogate_reward"] > 0.0
    penalised = improved(1000.0, multiplier_step=1.0)
    assert penalised["surrogate_cost_0"] < 0.0


def test_both_penalties_are_one_objective_before_anything_is_clipped() -> None:
    _, _, batch = fresh()
    rewards, costs = standardised_rewards(ADVANTAGES), ADVANTAGES[:, 1:]
    ratios = 1.0 + 0.1 * torch.arange(len(batch.actions)) / 10.0
    combined, separate = (
        float(SURROGATE_OBJECTIVES[penalty](batch, rewards, costs, np.array([2.0]), 0.2)(ratios))
        for penalty in ("combined", "separate")
    )
    assert combined == pytest.approx(separate, abs=1e-6)


def test_a_separate_penalty_is_not_clipped_by_hand() -> None:
    """At a ratio of 1.5 the reward's gain counts as 1.2, the cost's loss in full; the multiplier is 1."""
    _, _, batch = fresh()
    rewards, costs = np.array([6.0, 0, 0, 0, 0, 0]), np.array([[6.0], [0], [0], [0], [0], [0]])
    ratios = torch.ones(len(batch.actions))
    ratios[0] = 1.5
    found = {
        name: float(gain(batch, rewards, costs, np.ones(1), 0.2)(ratios))
        for name, gain in SURROGATE_OBJECTIVES.items()
    }
    assert found["separate"] == pytest.approx((1.2 - 1.5) / 2.0)
    assert found["combined"] == pytest.approx(0.0)


def test_gaps_are_measured_costs_minus_limits() -> None:
    measured = MeasuredCosts(np.zeros((1, 1, 1)), np.array([3.0]), np.array([1.0]), 20.0)
    found = measured.against(np.array([1.0]))
    assert (found.episode_length, found.gaps.tolist(), found.standard_errors.tolist()) == (20.0, [2.0], [1.0])

    assert measured.against(np.array([math.inf])).gaps.tolist() == [-math.inf]
