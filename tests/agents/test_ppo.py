"""The agents that know no constraint, and the ascent that first-order agents share."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, Space

from recrl.agents.algorithms.cpo import ConstrainedPolicyOptimisation
from recrl.agents.algorithms.own_options import CPOConfig, PPOConfig, TRPOConfig
from recrl.agents.algorithms.ppo import ProximalPolicyOptimisation
from recrl.agents.algorithms.trpo import TrustRegionPolicyOptimisation, trust_region_step
from recrl.agents.building_blocks.advantages import penalised_advantages
from recrl.agents.building_blocks.distributions import Categorical, Distribution, mean_divergence
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.experience import Constraints, Experience
from recrl.agents.learning.gradient_ascent import (
    Objective,
    gradient_ascent,
    normalised_by_penalties,
    with_entropy,
)
from recrl.agents.learning.policy_rule import PolicyRule, improve_and_measure
from recrl.agents.networks.flat_parameters import Adam
from recrl.environments.cmdp import Floats
from tests.agents.sampled import sampled

SPACES = [Discrete(3), Box(-1.0, 1.0, (2,))]
DELTA = 0.01


def rule_of(name: str, policy: StochasticPolicy) -> PolicyRule:
    if name == "ppo":
        return ProximalPolicyOptimisation(PPOConfig(target_kl=DELTA), policy)
    if name == "trpo":
        return TrustRegionPolicyOptimisation(TRPOConfig(target_kl=DELTA))
    return ConstrainedPolicyOptimisation(CPOConfig(target_kl=DELTA, violation_integral_gain=0.0), 2)


def improved(
    name: str, space: Space[object], gaps: list[float], limits: list[float]
) -> tuple[dict[str, float], Floats]:
    """The metrics, and the policy's parameters afterwards."""
    policy, batch, advantages = sampled(space)
    length = math.nan if math.isnan(gaps[0]) else 10.0
    constraints = Constraints(np.array(limits), np.array(gaps), np.zeros(len(limits)), length)
    experience = Experience.of(policy, batch, advantages, constraints)
    rule = rule_of(name, policy)
    metrics = improve_and_measure(rule, policy, experience, np.random.default_rng(0))
    return metrics, policy.parameters.to_numpy().astype(np.float64)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", ["ppo", "trpo"])
def test_neither_limits_nor_costs_nor_finished_episodes_change_a_control(
    name: str, space: Space[object]
) -> None:
    metrics, reference = improved(name, space, [9.0, 9.0], [1.0, 1.0])
    assert metrics["surrogate_reward"] > 0.0
    assert metrics["multiplier_0"] == metrics["multiplier_1"] == 0.0
    for gaps, limits in (([-9.0, -9.0], [10.0, math.inf]), ([math.nan, math.nan], [1.0, 1.0])):
        np.testing.assert_array_equal(improved(name, space, gaps, limits)[1], reference)


@pytest.mark.parametrize("space", SPACES)
def test_trpo_takes_the_step_that_cpo_takes_without_limits(space: Space[object]) -> None:
    gaps, unlimited = [-math.inf, -math.inf], [math.inf, math.inf]
    found, after = improved("trpo", space, gaps, unlimited)
    expected, after_cpo = improved("cpo", space, gaps, unlimited)
    np.testing.assert_allclose(after, after_cpo, atol=1e-5)
    assert found["surrogate_reward"] == pytest.approx(expected["surrogate_reward"], rel=1e-3)
    assert found["step_norm"] == pytest.approx(expected["step_norm"], rel=1e-3)


@pytest.mark.parametrize("space", SPACES)
def test_with_a_price_of_the_kl_a_step_is_as_long_as_the_gain_is_large_up_to_the_trust_region(
    space: Space[object],
) -> None:
    def stepped(size: float, kl_penalty: float) -> float:
        policy, batch, advantages = sampled(space)
        experience = Experience.of(policy, batch, advantages, KEPT)
        objective = size * (advantages[:, 0] - advantages[:, 0].mean())
        generator = np.random.default_rng(0)
        config = TRPOConfig(target_kl=DELTA)
        return trust_region_step(policy, experience, objective, config, generator, kl_penalty=kl_penalty)[
            "step_norm"
        ]

    edge = stepped(1.0, kl_penalty=0.0)
    assert stepped(1e-3, kl_penalty=0.0) == pytest.approx(edge, rel=1e-3)  # whatever is to be gained
    assert stepped(1e3, kl_penalty=1.0) == pytest.approx(edge, rel=1e-3)
    small = stepped(1e-3, kl_penalty=1.0)
    assert small < 0.1 * edge
    assert stepped(2e-3, kl_penalty=1.0) == pytest.approx(2.0 * small, rel=1e-3)
    assert stepped(1e-3, kl_penalty=2.0) == pytest.approx(0.5 * small, rel=1e-3)


def test_where_no_action_is_better_trpo_stays() -> None:
    policy, batch, _ = sampled(SPACES[0])
    before = policy.parameters.to_numpy()
    constraints = Constraints(np.array([1.0]), np.array([0.0]), np.zeros(1), 10.0)
    experience = Experience.of(policy, batch, np.zeros((400, 2)), constraints)
    metrics = improve_and_measure(rule_of("trpo", policy), policy, experience, np.random.default_rng(0))
    np.testing.assert_array_equal(policy.parameters.to_numpy(), before)
    assert metrics["policy_steps"] == metrics["step_norm"] == 0.0


KEPT = Constraints(np.array([1.0, 1.0]), np.array([-1.0, -1.0]), np.zeros(2), 10.0)


def climbed(**options: object) -> tuple[float, bool, set[int]]:
    """The steps taken up an advantage, whether the policy is another, and the samples a step uses."""
    policy, batch, advantages = sampled(SPACES[1])
    before = policy.parameters.to_numpy()
    sizes = set()

    def objective(part: Experience) -> Objective:
        weights = part.batch.per_pair(advantages[:, 0])
        sizes.add(len(part.batch.unique_observations))
        return lambda _, ratios: ratios @ weights

    metrics = gradient_ascent(
        policy,
        Adam(policy.parameters, 0.01),
        Experience.of(policy, batch, advantages, KEPT),
        objective,
        config=PPOConfig.model_validate(options),
        generator=np.random.default_rng(0),
    )
    return metrics["policy_steps"], bool(np.any(policy.parameters.to_numpy() != before)), sizes


def test_the_ascent_takes_its_steps_and_stops_when_it_has_gone_too_far() -> None:
    assert climbed(policy_steps=3, policy_passes=1, target_kl=1e9) == (3.0, True, {400})
    taken, moved, _ = climbed(policy_steps=100, target_kl=1e-4)
    assert moved
    assert 1.0 <= taken < 20.0


def test_with_minibatches_the_steps_are_those_of_the_passes_if_they_are_more() -> None:
    few = {"minibatch_size": 100, "target_kl": 1e9, "policy_passes": 3}
    assert climbed(policy_steps=2, **few) == (12.0, True, {100})
    assert climbed(policy_steps=20, **few) == (20.0, True, {100})
    taken, _, _ = climbed(policy_steps=2, minibatch_size=100, target_kl=1e-4)
    assert taken < 8.0


def test_an_entropy_bonus_adds_the_mean_entropy_in_nats() -> None:
    _, batch, _ = sampled(SPACES[0])
    uniform = Categorical(torch.log_softmax(torch.zeros(len(batch.unique_observations), 4), dim=1))
    objective = with_entropy(lambda ratios: ratios.sum(), batch, 0.5)
    assert float(objective(uniform, torch.ones(2))) == pytest.approx(2.0 + 0.5 * math.log(4.0), rel=1e-5)


def test_a_priced_gain_is_divided_by_one_and_its_price() -> None:
    _, batch, _ = sampled(SPACES[0])
    uniform = Categorical(torch.log_softmax(torch.zeros(len(batch.unique_observations), 4), dim=1))
    objective = normalised_by_penalties(lambda ratios: (ratios.sum(), 3.0))
    assert float(objective(uniform, torch.ones(2))) == 0.5


def test_the_lagrangians_advantages_are_the_ones_computed_by_hand() -> None:
    rewards, costs = np.array([1.0, -1.0]), np.array([[2.0, 0.0], [0.0, 4.0]])
    found = penalised_advantages(rewards, costs, np.array([1.0, 2.0]))
    assert found.tolist() == [-0.25, -2.25]


def test_the_ascent_stops_by_the_divergence_of_the_new_policy_from_the_old(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy, batch, advantages = sampled(SPACES[1])
    experience = Experience.of(
        policy, batch, advantages, Constraints(np.zeros(2), np.zeros(2), np.zeros(2), 10.0)
    )
    compared = []

    def spied(old: Distribution, new: Distribution, weights: torch.Tensor) -> torch.Tensor:
        compared.append(old is experience.old and new is not experience.old)
        return mean_divergence(old, new, weights)

    monkeypatch.setattr("recrl.agents.learning.gradient_ascent.mean_divergence", spied)
    rule_of("ppo", policy).improve(policy, experience, np.random.default_rng(0))
    assert compared
    assert all(compared)
