"""PCPO's projection against hand-computed steps and an independent solver; CRPO's choice; TRPO-Lagrangian."""

import math
from collections import Counter

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, Space
from scipy.optimize import nnls

from recrl.agents.algorithms.cpo import ConstrainedPolicyOptimisation
from recrl.agents.algorithms.crpo import (
    ConstraintRectifiedPolicyOptimisation,
    cost_step,
    most_violated,
    reward_step,
)
from recrl.agents.algorithms.own_options import CRPOConfig, PCPOConfig, TRPOLagConfig
from recrl.agents.algorithms.pcpo import projected_step
from recrl.agents.algorithms.trpo_lag import TRPOLagrangian
from recrl.agents.experience import Constraints, Experience
from recrl.agents.learning.policy_rule import PolicyRule, improve_and_measure
from recrl.agents.trust_region.cpo_dual import StepCase, StepProblem, projection_weights
from recrl.environments.cmdp import Floats
from tests.agents.sampled import sampled

DELTA = 0.01
SPACES = [Discrete(3), Box(-1.0, 1.0, (2,))]
EAST, NORTH = np.array([1.0, 0.0]), np.array([0.0, 1.0])


def step(gradient: Floats, costs: Floats, violations: list[float]) -> Floats:
    """PCPO's step with H = I and a trust region of radius 1."""
    problem = StepProblem(
        float(gradient @ gradient), costs @ gradient, costs @ costs.T, np.array(violations), 0.5
    )
    solution = projected_step(problem)
    return -(solution.gradient_weight * gradient + solution.constraint_weights @ costs)


@pytest.mark.parametrize(
    ("violation", "expected"),
    [
        (-2.0, [1.0, 0.0]),  # the reward's step holds the constraint
        (-0.25, [0.25, 0.0]),  # it is moved back to where the constraint begins
        (0.5, [-0.5, 0.0]),
        (3.0, [-1.0, 0.0]),  # too far: to the edge of the trust region
    ],
)
def test_the_step_is_the_one_computed_by_hand(violation: float, expected: list[float]) -> None:
    assert step(-EAST, EAST[None], [violation]) == pytest.approx(np.array(expected), abs=1e-12)


def test_the_projection_leaves_what_no_constraint_concerns() -> None:
    found = step(-EAST - NORTH, EAST[None], [0.0])
    assert found == pytest.approx([0.0, math.sqrt(0.5)])


def test_a_step_that_was_scaled_back_leaves_its_constraint_violated_though_it_is_within_reach() -> None:
    problem = StepProblem(1.0, np.array([-0.9]), np.eye(1), np.array([0.13]), 0.01)
    assert problem.reach == pytest.approx([0.1414], abs=1e-4)
    assert problem.after(projected_step(problem)) == pytest.approx([0.00222], abs=1e-5)


def test_the_published_weight_of_one_constraint() -> None:
    assert projection_weights(np.array([[4.0]]), np.array([2.0])) == pytest.approx([0.5])
    assert projection_weights(np.array([[4.0]]), np.array([-2.0])) == pytest.approx([0.0])


def test_constraints_that_contradict_one_another_mend_the_worst() -> None:
    costs = np.stack([NORTH, -NORTH])
    assert projection_weights(costs @ costs.T, np.array([0.1, 0.4])) is None
    found = step(-EAST, costs, [0.1, 0.4])
    assert found[1] > 0.0
    assert float(np.linalg.norm(found)) == pytest.approx(1.0)


def test_contradicting_constraints_do_not_stop_the_line_search() -> None:
    """The second cost rises by what the first falls; only the first is asked to fall."""
    gram = np.array([[1.0, -1.0], [-1.0, 1.0]])
    solution = projected_step(StepProblem(1.0, np.zeros(2), gram, np.array([0.4, 0.1]), 0.02))
    assert (solution.case, solution.recovered) == (StepCase.RECOVERY, (0,))


def test_of_contradicting_constraints_one_without_influence_is_not_the_worst() -> None:
    gram = np.array([[1e-14, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, -1.0, 1.0]])
    problem = StepProblem(1.0, np.zeros(3), gram, np.array([5.0, 0.1, 0.4]), radius=0.5)
    found = projected_step(problem).constraint_weights
    assert found[:2].tolist() == [0.0, 0.0]
    assert found[2] == pytest.approx(0.4 / np.sqrt(1.16))  # of length sqrt(1 + 0.4^2), scaled back to 1


def test_a_cost_that_no_step_can_change_is_left_out() -> None:
    assert step(-EAST, np.zeros((1, 2)), [3.0]) == pytest.approx(EAST)
    assert step(np.zeros(2), np.zeros((1, 2)), [3.0]) == pytest.approx([0.0, 0.0])


@pytest.mark.parametrize("num_costs", [1, 2, 3, 4, 8])
def test_the_projection_is_the_independent_solvers(num_costs: int) -> None:
    """With S = B B^T, nu minimises |B^T nu - z|^2 over nu >= 0, where B z = e: non-negative least squares."""
    generator = np.random.default_rng(num_costs)
    binding = Counter[int]()
    for _ in range(250 if num_costs < 8 else 25):
        costs = generator.normal(size=(num_costs, 9))
        excesses = generator.normal(-0.2, 1.0, size=num_costs)
        found = projection_weights(costs @ costs.T, excesses)
        assert found is not None
        expected, _ = nnls(costs.T, np.linalg.lstsq(costs, excesses)[0])
        assert found == pytest.approx(expected, abs=1e-9)
        binding[int(np.count_nonzero(found))] += 1
    assert set(binding) >= set(range(min(num_costs, 4) + 1)) - ({0} if num_costs == 8 else set())


@pytest.mark.parametrize("num_costs", [1, 2, 4])
def test_every_projected_step_stays_in_the_trust_region(num_costs: int) -> None:
    generator = np.random.default_rng(num_costs)
    cases = Counter[StepCase]()
    for _ in range(200):
        gradient, costs = generator.normal(size=6), generator.normal(size=(num_costs, 6))
        violations = generator.normal(-0.3, 1.0, size=num_costs)
        problem = StepProblem(float(gradient @ gradient), costs @ gradient, costs @ costs.T, violations, 0.5)
        solution = projected_step(problem)
        x = -(solution.gradient_weight * gradient + solution.constraint_weights @ costs)
        cases[solution.case] += 1
        assert float(x @ x) <= 1.0 + 1e-9
        unscaled = solution.gradient_weight == pytest.approx(1.0 / math.sqrt(problem.squared_gradient))
        assert not unscaled or np.all(problem.after(solution) <= 1e-9)
    assert set(cases) == {StepCase.UNCONSTRAINED, StepCase.CONSTRAINED}


def rule_of(name: str, num_costs: int) -> PolicyRule:
    if name == "pcpo":
        config = PCPOConfig(target_kl=DELTA, violation_integral_gain=0.0)
        return ConstrainedPolicyOptimisation(config, num_costs, projected_step)
    if name == "crpo":
        return ConstraintRectifiedPolicyOptimisation(CRPOConfig(target_kl=DELTA))
    return TRPOLagrangian(TRPOLagConfig(target_kl=DELTA), num_costs)


def improved(
    name: str, space: Space[object], gaps: list[float], limits: list[float]
) -> tuple[dict[str, float], Floats]:
    """The metrics of one update, and how the policy's parameters have changed."""
    policy, batch, advantages = sampled(space)
    before, old = policy.parameters.to_numpy(), policy.distribution(batch.unique_observations)
    constraints = Constraints(np.array(limits), np.array(gaps), np.zeros(len(limits)), 10.0)
    experience = Experience.of(policy, batch, advantages, constraints)
    metrics = improve_and_measure(rule_of(name, 2), policy, experience, np.random.default_rng(0))
    moved = old.divergence(policy.distribution(batch.unique_observations))  # type: ignore[arg-type]
    metrics["kl"] = float(torch.dot(batch.observation_weights, moved))
    return metrics, (policy.parameters.to_numpy() - before).astype(np.float64)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", ["pcpo", "crpo", "trpo-lag"])
def test_the_step_serves_the_constraints_within_the_trust_region(name: str, space: Space[object]) -> None:
    violated, change = improved(name, space, [30.0, -9.0], [1.0, 10.0])
    assert violated["surrogate_cost_0"] < 0.0
    assert violated["policy_steps"] == 1.0
    assert 0.0 < violated["kl"] <= DELTA
    assert float(np.linalg.norm(change)) == pytest.approx(violated["step_norm"], rel=1e-3)
    free, _ = improved(name, space, [-math.inf, -math.inf], [math.inf, math.inf])
    assert free["surrogate_reward"] > 0.0
    assert free["multiplier_0"] == free["multiplier_1"] == 0.0


def crpo_sizes(gradient: list[float], violation: float, kl_penalty: float) -> tuple[float, float]:
    """How long CRPO's steps up the reward and down the cost are, with H = I, b = (1, 0), and radius 1."""
    g, costs = np.array(gradient), EAST[None]
    problem = StepProblem(float(g @ g), -costs @ g, costs @ costs.T, np.array([violation]), 0.5)
    config = CRPOConfig(kl_penalty=kl_penalty)
    return reward_step(problem, config).gradient_weight, cost_step(problem, 0, config).constraint_weights[0]


def test_crpos_steps_end_at_the_limit_where_nothing_is_left_to_gain() -> None:
    assert crpo_sizes([1.0, 0.0], -0.05, 1.0)[0] == pytest.approx(0.05)
    assert crpo_sizes([1.0, 0.0], 0.1, 1.0)[1] == pytest.approx(0.1)


def test_crpos_steps_go_beyond_the_limit_for_what_is_left_to_gain() -> None:
    # p = 1 - 0.6^2, beta = 0.8 / 2; the reward's step raises the cost by 0.6.
    assert crpo_sizes([0.6, 0.8], -0.06, 1.0)[0] == pytest.approx(0.06 / 0.6 + 0.4)
    assert crpo_sizes([0.6, 0.8], 0.1, 1.0)[1] == pytest.approx(0.1 + 0.4 * 0.6)


def test_crpos_steps_are_as_long_as_the_trust_region_far_from_limits_and_without_a_price() -> None:
    assert crpo_sizes([0.6, 0.8], -9.0, 1.0)[0] == pytest.approx(1.0)
    assert crpo_sizes([0.6, 0.8], 9.0, 1.0)[1] == pytest.approx(1.0)
    assert crpo_sizes([1.0, 0.0], 0.01, 0.0) == pytest.approx((1.0, 1.0))
    assert crpo_sizes([-1.0, 0.0], 0.01, 0.0) == pytest.approx((1.0, 1.0))


def test_a_limit_beyond_the_reach_of_crpos_step_does_not_shorten_it() -> None:
    """A second cost with the gradient (0, 1): with both at hand nothing is left to gain, with one 0.8 is."""
    g, costs = np.array([0.6, 0.8]), np.eye(2)
    config = CRPOConfig(kl_penalty=1.0)
    for second, left in ((-0.5, 0.0), (-1.5, 0.8)):
        problem = StepProblem(1.0, -costs @ g, costs @ costs.T, np.array([-0.06, second]), 0.5)
        assert reward_step(problem, config).gradient_weight == pytest.approx(0.06 / 0.6 + left / 2.0)


def test_crpo_rests_where_nothing_can_be_changed() -> None:
    nothing = StepProblem(0.0, np.zeros(1), np.zeros((1, 1)), np.array([0.1]), 0.5)
    assert reward_step(nothing, CRPOConfig()).gradient_weight == 0.0


def test_crpo_mends_what_is_most_violated_in_its_own_spread() -> None:
    ones, all_ = np.ones(3), np.full(3, True)
    assert most_violated(np.array([-1.0, 0.0, -math.inf]), ones, 0.0, all_) is None
    assert most_violated(np.array([0.4, 0.2, -math.inf]), ones, 0.5, all_) is None
    assert most_violated(np.array([1.0, 2.0, -math.inf]), ones, 0.5, all_) == 1
    assert most_violated(np.array([1.0, 2.0, -math.inf]), np.array([1.0, 4.0, 1.0]), 0.5, all_) == 0


def test_crpo_passes_over_a_violated_cost_that_no_step_can_change() -> None:
    gaps, ones = np.array([9.0, 2.0, -math.inf]), np.ones(3)
    assert most_violated(gaps, ones, 0.5, np.array([False, True, True])) == 1
    assert most_violated(gaps, ones, 0.5, np.array([False, False, True])) is None
