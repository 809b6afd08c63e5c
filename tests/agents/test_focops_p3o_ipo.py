"""FOCOPS, P3O and IPO: what each climbs, against hand-computed numbers and finite differences."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete

from recrl.agents.algorithms.focops import FirstOrderConstrainedOptimisation, projection_objective
from recrl.agents.algorithms.ipo import (
    InteriorPointPolicyOptimisation,
    barrier,
    barrier_surrogate_objective,
    relief_of,
    slopes,
)
from recrl.agents.algorithms.own_options import FOCOPSConfig, IPOConfig, P3OConfig
from recrl.agents.algorithms.p3o import PenalisedProximalPolicyOptimisation, penalised_surrogate_objective
from recrl.agents.building_blocks.distributions import Categorical
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.experience import Constraints, Experience
from recrl.agents.learning.policy_rule import PolicyRule, improve_and_measure
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal
from recrl.environments.cmdp import Floats

STATES = np.array([0, 0, 1, 1, 1, 2])
ACTIONS = np.array([0, 1, 0, 1, 1, 0])
ADVANTAGES = np.array([[1.0, 2.0], [-1.0, 0.0], [2.0, 1.0], [0.0, 0.0], [-3.0, 1.0], [1.0, 2.0]])
BATCH = LearningBatch.deduplicate(np.eye(3, dtype=np.float32)[STATES], ACTIONS, compact=False)
CLIP, KAPPA = 0.2, 5.0


# Rewards standardised: mean 0, standard deviation sqrt(16 / 6); costs centred about 1.
SPREAD, COST_SPREAD = math.sqrt(16.0 / 6.0), math.sqrt(4.0 / 6.0)
REWARDS, COSTS = ADVANTAGES[:, 0] / SPREAD, (ADVANTAGES[:, 1:] - 1.0) / SPREAD


def violation(cost_per_step: float) -> Floats:
    return np.array([cost_per_step / SPREAD])


def test_p3os_gain_is_the_one_computed_by_hand() -> None:
    ratios = torch.tensor([1.0, 1.0, 1.5, 1.0, 1.0, 1.0])
    # Reward: only sample 2 has moved, its ratio counts as 1.2: (0.2 * 2) / 6 spreads.
    # Cost: its centred advantage is 0, so the surrogate stays 0 and the violation 0.3 stands.
    gain = penalised_surrogate_objective(BATCH, REWARDS, COSTS, violation(0.3), clip=CLIP, factor=KAPPA)
    value, weight = gain(ratios)
    assert float(value) == pytest.approx((0.4 / 6.0 - KAPPA * 0.3) / SPREAD, rel=1e-5)
    assert weight == KAPPA


def test_p3o_is_pessimistic_about_cost() -> None:
    gain = penalised_surrogate_objective(BATCH, REWARDS, COSTS, violation(0.3), clip=CLIP, factor=KAPPA)
    # Sample 1 has the reward advantage -1 and the cost advantage -1: the ratio 1.6 saves no more cost than
    # 1.2 would, and loses all the reward.
    value, _ = gain(torch.tensor([1.0, 1.6, 1.0, 1.0, 1.0, 1.0]))
    assert float(value) == pytest.approx((-0.6 / 6.0 - KAPPA * (0.3 - 0.2 / 6.0)) / SPREAD, rel=1e-5)


def test_a_constraint_that_holds_costs_p3o_nothing() -> None:
    gain = penalised_surrogate_objective(BATCH, REWARDS, COSTS, violation(-1.0), clip=CLIP, factor=KAPPA)
    value, weight = gain(torch.ones(6))
    assert float(value) == pytest.approx(0.0, abs=1e-6)
    assert weight == 0.0


def test_the_barrier_is_a_logarithm_that_goes_on_along_its_tangent() -> None:
    slack = torch.tensor([1.0, math.exp(-1.0), 0.05, 0.0, -1.0], dtype=torch.float64)
    found = barrier(slack, sharpness=4.0, slope=5.0)  # the tangent begins at 1 / 20
    edge = math.log(0.05) / 4.0
    assert found.tolist() == pytest.approx([0.0, -0.25, edge, edge - 0.25, edge - 5.25], rel=1e-12)


def test_the_barriers_slopes_are_its_finite_differences() -> None:
    config = IPOConfig(barrier_sharpness=4.0, barrier_slope=5.0)
    slack = torch.tensor([2.0, 0.3, 0.06, 0.04, 0.0, -3.0], dtype=torch.float64)
    step = 1e-6
    high, low = (barrier(slack + change, sharpness=4.0, slope=5.0) for change in (step, -step))
    differences = ((high - low) / (2.0 * step)).numpy()
    np.testing.assert_allclose(slopes(slack.numpy(), config), differences, rtol=1e-6)
    leaf = slack.clone().requires_grad_()
    exact = torch.autograd.grad(barrier(leaf, sharpness=4.0, slope=5.0).sum(), leaf)[0]
    np.testing.assert_allclose(exact.numpy(), differences, rtol=1e-6)


def test_ipos_gain_is_the_one_computed_by_hand() -> None:
    config = IPOConfig(barrier_sharpness=10.0, barrier_slope=20.0, clip=CLIP)
    value, weight = barrier_surrogate_objective(BATCH, REWARDS, COSTS, violation(-0.5), config)(torch.ones(6))
    slack = 0.5 / SPREAD
    assert float(value) == pytest.approx(math.log(slack) / 10.0, rel=1e-5)
    assert weight == pytest.approx(1.0 / (10.0 * slack), rel=1e-5)


def test_ipo_counts_relief_up_to_the_clip_range_and_the_papers_goes_on() -> None:
    # Sample 1 has the cost advantage -1: at the ratio 1.6 it would save 0.6 / 6, clipped 0.2 / 6.
    ratios = torch.tensor([1.0, 1.6, 1.0, 1.0, 1.0, 1.0])
    clipped, plain = (
        relief_of(BATCH, COSTS, IPOConfig(clip=CLIP, cost_surrogate=name))(ratios)
        for name in ("pessimistic", "plain")
    )
    assert (SPREAD * clipped).tolist() == pytest.approx([0.2 / 6.0], rel=1e-5)
    assert (SPREAD * plain).tolist() == pytest.approx([0.6 / 6.0], rel=1e-5)


def test_focops_weighs_what_is_gained_against_how_far_the_policy_moves() -> None:
    old = Categorical(torch.log(torch.full((6, 2), 0.5)))
    now_probs = torch.full((6, 2), 0.5)
    now_probs[0] = torch.tensor([0.6, 0.4])
    now_probs[1] = torch.tensor([0.1, 0.9])  # further than the radius: pulls no more
    now = Categorical(torch.log(now_probs))
    ratios = torch.tensor([1.2, 1.8, 1.0, 1.0, 1.0, 1.0])
    advantages = np.array([3.0, 5.0, 0.0, 0.0, 0.0, 1.0])
    constraints = Constraints(np.ones(1), np.ones(1), np.zeros(1), 1.0)
    experience = Experience(BATCH, old, torch.zeros(6), ADVANTAGES, constraints)
    objective = projection_objective(experience, advantages, focops_lambda=2.0, radius=0.1)
    divergence = 0.6 * math.log(1.2) + 0.4 * math.log(0.8)
    expected = (1.2 * 3.0 / 2.0 + 1.0 / 2.0 - divergence) / 6.0
    assert float(objective(now, ratios)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("agent", ["focops", "p3o"])
def test_the_trust_region_is_kept_however_long_a_step_is(agent: str) -> None:
    found = {}
    for name in ("kept", "passed"):
        policy = make_policy(
            3, Discrete(2), NetworkArchitecture((8,), orthogonal), 1.0, torch.Generator().manual_seed(0)
        )
        constraints = Constraints(np.array([math.inf]), np.array([-math.inf]), np.zeros(1), 10.0)
        experience = Experience.of(policy, BATCH, ADVANTAGES, constraints)
        options = {"target_kl": 0.01, "policy_learning_rate": 0.1, "trust_region": name}
        rule: PolicyRule = (
            FirstOrderConstrainedOptimisation(FOCOPSConfig(**options), policy, 1)
            if agent == "focops"
            else PenalisedProximalPolicyOptimisation(P3OConfig(**options), policy, 1)
        )
        found[name] = improve_and_measure(rule, policy, experience, np.random.default_rng(0))["kl"]
    assert found["passed"] > 0.05
    assert found["kept"] == pytest.approx(0.01, rel=0.2)


def improved(name: str, gap: float, limit: float = 5.0) -> tuple[dict[str, float], bool]:
    """The metrics of one update, and whether the policy is another."""
    generator = torch.Generator().manual_seed(0)
    policy = make_policy(3, Discrete(2), NetworkArchitecture((8,), orthogonal), 1.0, generator)
    before = policy.parameters.to_numpy()
    rules: dict[str, PolicyRule] = {
        "focops": FirstOrderConstrainedOptimisation(FOCOPSConfig(), policy, 1),
        "p3o": PenalisedProximalPolicyOptimisation(P3OConfig(), policy, 1),
        "ipo": InteriorPointPolicyOptimisation(IPOConfig(), policy, 1),
    }
    constraints = Constraints(np.array([limit]), np.array([gap]), np.zeros(1), 10.0)
    experience = Experience.of(policy, BATCH, ADVANTAGES, constraints)
    metrics = improve_and_measure(rules[name], policy, experience, np.random.default_rng(0))
    return metrics, bool(np.any(policy.parameters.to_numpy() != before))


@pytest.mark.parametrize("name", ["focops", "p3o", "ipo"])
def test_a_violated_constraint_is_mended_and_no_limit_is_no_penalty(name: str) -> None:
    violated, _ = improved(name, 1000.0)
    assert violated["surrogate_cost_0"] < 0.0
    assert violated["multiplier_0"] > 0.0
    free, _ = improved(name, -math.inf, math.inf)
    assert free["surrogate_reward"] > 0.0
    assert free["multiplier_0"] == 0.0


def test_the_slope_of_the_barrier_is_what_ipo_reports_as_its_multiplier() -> None:
    reported = improved("ipo", -5.0)[0]["multiplier_0"]
    expected: Floats = slopes(np.array([0.5 / COST_SPREAD]), IPOConfig())
    assert reported == pytest.approx(float(expected[0]) * SPREAD / COST_SPREAD)
