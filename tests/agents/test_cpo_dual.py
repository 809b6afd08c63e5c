"""CPO's step against hand-computed steps, the published k = 1 formulas, and an independent solver."""

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import pytest
from scipy.optimize import minimize, nnls

from recrl.agents.trust_region.cpo_dual import DualSolution, StepCase, StepProblem, solve_dual
from recrl.environments.cmdp import Floats


def reduced(gradient: Floats, costs: Floats, violations: Floats, radius: float) -> StepProblem:
    """The problem with H = I, gradient [n] and cost gradients [k, n]."""
    return StepProblem(float(gradient @ gradient), costs @ gradient, costs @ costs.T, violations, radius)


def step(solution: DualSolution, gradient: Floats, costs: Floats) -> Floats:
    """The step a solution stands for, with H = I, [n]."""
    return -(solution.gradient_weight * gradient + solution.constraint_weights @ costs)


EAST, NORTH = np.array([1.0, 0.0]), np.array([0.0, 1.0])


@pytest.mark.parametrize(
    ("violation", "case", "expected", "multiplier"),
    [
        (-2.0, StepCase.UNCONSTRAINED, [1.0, 0.0], 0.0),  # the whole region is feasible
        (-0.5, StepCase.UNCONSTRAINED, [1.0, 0.0], 0.0),  # the boundary is crossed elsewhere
        (0.6, StepCase.CONSTRAINED, [0.8, -0.6], 0.75),  # lam = 1 / 0.8, nu = 0.6 lam
        (1.0, StepCase.CONSTRAINED, [0.0, -1.0], math.nan),  # one feasible point
        (1.5, StepCase.RECOVERY, [0.0, -1.0], math.nan),
    ],
)
def test_the_step_is_the_one_computed_by_hand(
    violation: float, case: StepCase, expected: list[float], multiplier: float
) -> None:
    gradient, costs = -EAST, NORTH[None]
    solution = solve_dual(reduced(gradient, costs, np.array([violation]), 0.5))
    assert solution.case is case
    assert step(solution, gradient, costs) == pytest.approx(np.array(expected), abs=1e-9)
    if math.isfinite(multiplier):
        assert solution.multipliers == pytest.approx([multiplier])


def test_the_constraint_that_points_against_the_reward_binds() -> None:
    gradient, costs = -EAST, EAST[None]
    solution = solve_dual(reduced(gradient, costs, np.array([-0.25]), 0.5))
    assert solution.case is StepCase.CONSTRAINED
    assert (step(solution, gradient, costs) @ EAST) == pytest.approx(0.25)


@pytest.mark.parametrize("beside", [1e-4, 1e-3, 3e-3])
def test_a_reward_that_is_almost_a_cost_still_meets_the_other_constraints(beside: float) -> None:
    gradient, costs = -EAST + beside * NORTH, np.stack([EAST, NORTH])
    solution = solve_dual(reduced(gradient, costs, np.array([-0.2, 0.3]), 0.5))
    assert solution.case is StepCase.CONSTRAINED
    found = step(solution, gradient, costs)
    assert found @ EAST == pytest.approx(0.2) and found @ NORTH <= -0.3 + 1e-9


def test_recovery_goes_towards_the_nearest_point_that_meets_all_constraints() -> None:
    # Cost 1 is in units a hundred times smaller: that point is 10 steps of length 1 west and 5 south.
    costs = np.stack([EAST, 100.0 * NORTH])
    solution = solve_dual(reduced(-EAST, costs, np.array([10.0, 500.0]), 0.5))
    assert solution.recovered == (0, 1)
    assert step(solution, -EAST, costs) == pytest.approx((-10.0 * EAST - 5.0 * NORTH) / np.sqrt(125.0))


def test_recovery_leaves_constraints_that_hold_as_they_are() -> None:
    # North-east must fall by far; north is at its limit and would rise by going south-west, were it south.
    costs = np.stack([EAST + NORTH, -NORTH])
    solution = solve_dual(reduced(-EAST, costs, np.array([10.0, 0.0]), 0.5))
    assert solution.recovered == (0,)
    assert step(solution, -EAST, costs) == pytest.approx(-EAST)


def test_constraints_that_hinder_one_another_stay_violated_though_each_alone_could_be_met() -> None:
    gram = np.array([[1.0, -0.9], [-0.9, 1.0]])
    problem = StepProblem(1.0, np.zeros(2), gram, np.full(2, 0.1), 0.01)
    assert problem.reach == pytest.approx([0.1414, 0.1414], abs=1e-4)  # sqrt(0.02)
    assert problem.after(solve_dual(problem)) == pytest.approx([0.0684, 0.0684], abs=1e-3)


def test_where_constraints_contradict_one_another_recovery_lowers_the_furthest_from_its_limit() -> None:
    costs = np.stack([EAST, -100.0 * EAST])
    solution = solve_dual(reduced(NORTH, costs, np.array([10.0, 500.0]), 0.5))
    assert solution.recovered == (0,)
    assert step(solution, NORTH, costs) == pytest.approx(-EAST)


def test_a_violation_beside_a_hugely_slack_constraint_is_still_mended() -> None:
    problem = StepProblem(1.0, np.zeros(2), np.diag([1.0, 1e-5]), np.array([-2.5e6, 1e-3]), 0.01)
    solution = solve_dual(problem)
    assert solution.case is StepCase.RECOVERY
    assert solution.recovered == (1,)
    assert solution.constraint_weights == pytest.approx([0.0, math.sqrt(2.0 * 0.01 / 1e-5)])


def test_a_cost_that_no_step_can_change_is_left_out() -> None:
    costs = np.zeros((1, 2))
    for violation in (-1.0, 1.0):
        solution = solve_dual(reduced(-EAST, costs, np.array([violation]), 0.5))
        assert solution.case is StepCase.UNCONSTRAINED
        assert step(solution, -EAST, costs) == pytest.approx(EAST)


def test_no_constraint_gives_the_trust_region_step() -> None:
    solution = solve_dual(reduced(-3.0 * EAST, np.empty((0, 2)), np.empty(0), 0.02))
    assert step(solution, -3.0 * EAST, np.empty((0, 2))) == pytest.approx(0.2 * EAST)


def test_a_vanished_reward_gradient_still_mends_a_violation() -> None:
    costs = NORTH[None]
    solution = solve_dual(reduced(np.zeros(2), costs, np.array([0.3]), 0.5))
    assert step(solution, np.zeros(2), costs) == pytest.approx(-0.3 * NORTH)


def test_the_same_constraint_twice_changes_nothing() -> None:
    once = solve_dual(reduced(-EAST, NORTH[None], np.array([0.6]), 0.5))
    costs = np.stack([NORTH, 2.0 * NORTH])
    twice = solve_dual(reduced(-EAST, costs, np.array([0.6, 1.2]), 0.5))
    assert step(twice, -EAST, costs) == pytest.approx(step(once, -EAST, NORTH[None]))


@pytest.mark.parametrize("angle", [1e-9, 1e-7, 1e-5])
def test_a_constraint_that_differs_by_float32s_rounding_changes_nothing(angle: float) -> None:
    """Products of almost parallel gradients have rounding errors that must not look like a direction."""
    generator = np.random.default_rng(2)
    cases = Counter[StepCase]()
    for _ in range(300):
        gradient, cost, other = generator.normal(size=(3, 6))
        violation, another = 0.3 * generator.normal(size=2)
        twin, costs = cost + angle * generator.normal(size=6), np.stack([cost, other])
        violations = np.array([violation, another, violation + angle * generator.normal()])
        rounded = np.stack([gradient, *costs, twin]).astype(np.float32)
        products = (rounded @ rounded.T).astype(np.float64)
        solution = solve_dual(
            StepProblem(products[0, 0], products[0, 1:], products[1:, 1:], violations, 0.01)
        )
        once = solve_dual(reduced(gradient, costs, violations[:2], 0.01))
        assert solution.case is once.case
        found = step(solution, gradient, np.stack([*costs, twin]))
        assert found == pytest.approx(step(once, gradient, costs), abs=2e-3 * math.sqrt(0.02))
        cases[solution.case] += 1
    assert min(cases[case] for case in StepCase) > 20


def published(problem: StepProblem) -> tuple[float, float]:
    """1 / lam and nu / lam for k = 1 by safety-starter-agents' case distinction."""
    q, r, s = problem.squared_gradient, problem.mixed[0], problem.gram[0, 0]
    c, delta = problem.violations[0], problem.radius
    remaining, slack = q - r**2 / s, 2.0 * delta - c**2 / s
    if c < 0.0 and slack < 0.0:
        return 1.0 / math.sqrt(q / (2.0 * delta)), 0.0
    if slack < 0.0:
        return 0.0, math.sqrt(2.0 * delta / s)
    bound = r / c
    inside, outside = (0.0, bound), (bound, math.inf)
    with_cost, without = (inside, outside) if c < 0.0 else (outside, inside)
    lam_a = max(with_cost[0], min(with_cost[1], math.sqrt(remaining / slack)))
    lam_b = max(without[0], min(without[1], math.sqrt(q / (2.0 * delta))))
    dual_a = -0.5 * (remaining / (lam_a + 1e-300) + lam_a * slack) - r * c / s
    dual_b = -0.5 * (q / (lam_b + 1e-300) + lam_b * 2.0 * delta)
    lam = lam_a if dual_a >= dual_b else lam_b
    nu = max(0.0, lam * c - r) / s
    return 1.0 / lam, nu / lam


def test_one_constraint_gives_the_published_solution() -> None:
    generator = np.random.default_rng(1)
    cases = Counter[StepCase]()
    for _ in range(1000):
        gradient, costs = generator.normal(size=5), generator.normal(size=(1, 5))
        violation = generator.normal(size=1) * generator.choice([0.1, 0.5, 2.0])
        problem = reduced(gradient, costs, violation, 0.1)
        solution = solve_dual(problem)
        cases[solution.case] += 1
        gradient_weight, weight = published(problem)
        expected = -(gradient_weight * gradient + weight * costs[0])
        assert step(solution, gradient, costs) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert min(cases[case] for case in StepCase) > 100


@dataclass(frozen=True)
class RandomProblem:
    """A problem in n = 6 parameters with k constraints.

    Attributes:
        metric: H, [n, n].
        gradient: g, [n].
        costs: b_i, [k, n].
        violations: c, [k].
        radius: delta.
    """

    metric: Floats
    gradient: Floats
    costs: Floats
    violations: Floats
    radius: float = 0.1

    @classmethod
    def draw(cls, generator: np.random.Generator, num_costs: int) -> Self:
        root = np.eye(6) + 0.2 * generator.normal(size=(6, 6))
        return cls(
            root @ root.T,
            generator.normal(size=6),
            generator.normal(size=(num_costs, 6)),
            generator.normal(-0.1, 0.4, size=num_costs),
        )

    def reduced(self) -> StepProblem:
        by_gradient = np.linalg.solve(self.metric, self.gradient)
        by_costs = np.linalg.solve(self.metric, self.costs.T)
        return StepProblem(
            float(self.gradient @ by_gradient),
            self.costs @ by_gradient,
            self.costs @ by_costs,
            self.violations,
            self.radius,
        )

    def objective(self, x: Floats) -> float:
        return float(self.gradient @ x)

    def step(self, solution: DualSolution) -> Floats:
        direction = solution.gradient_weight * self.gradient + solution.constraint_weights @ self.costs
        return np.asarray(-np.linalg.solve(self.metric, direction), dtype=np.float64)

    def shortest_feasible(self) -> float:
        """x.H x / 2 of the shortest step that meets all constraints, or infinity.

        Least-distance programming (Lawson and Hanson 1974, chapter 23), by non-negative least squares.
        """
        whitened = np.linalg.solve(np.linalg.cholesky(self.metric), self.costs.T).T
        system = np.vstack([-whitened.T, self.violations])
        target = np.append(np.zeros(6), 1.0)
        residual = system @ nnls(system, target)[0] - target
        if abs(residual[-1]) < 1e-12:
            return math.inf
        return float(0.5 * np.sum((residual[:-1] / residual[-1]) ** 2))

    def by_slsqp(self, start: Floats) -> Floats | None:
        """The optimal step by sequential quadratic programming, or None if it does not converge."""
        result = minimize(  # type: ignore[call-overload]
            self.objective,
            start,
            jac=lambda _: self.gradient,
            method="SLSQP",
            constraints=[
                {
                    "type": "ineq",
                    "fun": lambda x: -(self.costs @ x + self.violations),
                    "jac": lambda _: -self.costs,
                },
                {
                    "type": "ineq",
                    "fun": lambda x: self.radius - 0.5 * x @ self.metric @ x,
                    "jac": lambda x: -self.metric @ x,
                },
            ],
            options={"maxiter": 200, "ftol": 1e-12},
        )
        return np.asarray(result.x) if result.success else None


def duality_gap(problem: RandomProblem, solution: DualSolution, x: Floats) -> float:
    """g.x minus the Lagrangian dual at the solution's multipliers: 0 proves that both are optimal.

    max over lam of the dual: -sqrt(2 delta |g + sum nu_i b_i|^2) + nu.c, in the norm of H^-1.
    """
    pull = problem.gradient + solution.multipliers @ problem.costs
    squared = float(pull @ np.linalg.solve(problem.metric, pull))
    dual = -math.sqrt(2.0 * problem.radius * squared) + float(solution.multipliers @ problem.violations)
    return float(problem.gradient @ x) - dual


@pytest.mark.parametrize("num_costs", [1, 2, 3, 4, 8])
def test_every_step_is_feasible_and_proves_its_optimality(num_costs: int) -> None:
    generator = np.random.default_rng(num_costs)
    seen = Counter[tuple[StepCase, int]]()
    for _ in range(300 if num_costs < 8 else 30):
        problem = RandomProblem.draw(generator, num_costs)
        solution = solve_dual(problem.reduced())
        x = problem.step(solution)
        excess = problem.costs @ x + problem.violations
        seen[solution.case, int(np.sum(np.abs(excess) < 1e-9))] += 1
        assert 0.5 * x @ problem.metric @ x <= problem.radius * (1.0 + 1e-9)
        assert (solution.case is StepCase.RECOVERY) == (problem.shortest_feasible() > problem.radius)
        if solution.case is not StepCase.RECOVERY:
            assert np.all(excess <= 1e-9)
            assert duality_gap(problem, solution, x) == pytest.approx(0.0, abs=1e-8)
    rare = {StepCase.UNCONSTRAINED} if num_costs == 8 else set()
    assert {case for case, _ in seen} >= set(StepCase) - rare
    binding = {count for case, count in seen if case is StepCase.CONSTRAINED}
    assert binding >= set(range(1, min(num_costs, 3) + 1))


@pytest.mark.parametrize("num_costs", [1, 2, 3, 4])
def test_the_step_is_the_independent_solvers(num_costs: int) -> None:
    generator = np.random.default_rng(10 + num_costs)
    compared = Counter[StepCase]()
    while compared.total() < 250:  # 1,000 with all k
        drawn = RandomProblem.draw(generator, num_costs)
        # With few constraints, few problems of the usual size have no feasible step.
        problem = replace(drawn, violations=drawn.violations * generator.choice([1.0, 4.0]))
        solution = solve_dual(problem.reduced())
        if solution.case is StepCase.RECOVERY:
            compared[solution.case] += 1
            assert problem.shortest_feasible() > problem.radius
            continue
        expected = problem.by_slsqp(0.01 * generator.normal(size=6))
        if expected is None:
            continue
        compared[solution.case] += 1
        found = problem.objective(problem.step(solution))
        assert found == pytest.approx(problem.objective(expected), rel=1e-6, abs=1e-6)
    assert min(compared[case] for case in StepCase) >= 5


def test_units_matter_c_is_cost_per_step() -> None:
    """An episode of 100 steps that costs 5 too much is violated by 0.05 a step."""
    problem = reduced(-EAST, 0.1 * NORTH[None], np.array([5.0 / 100.0]), 0.5)
    assert solve_dual(problem).case is StepCase.CONSTRAINED
