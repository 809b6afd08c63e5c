"""The integral of the violations: its arithmetic, its anti-wind-up, and the steady error that it removes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from recrl.agents.algorithms.pcpo import projected_step
from recrl.agents.constraints.violation_integral import ViolationIntegral
from recrl.agents.experience import Constraints
from recrl.agents.trust_region.cpo_dual import StepCase, StepProblem, solve_dual

BOTH = np.array([0, 1])


def after(integral: ViolationIntegral, *gaps: float, limit: float = 100.0) -> list[float]:
    """The corrected gaps after new ones; a gap of -inf is that of a cost without a limit."""
    found = np.array(gaps)
    limits = np.where(np.isfinite(found), limit, np.inf)
    corrected: list[float] = integral.corrected(
        Constraints(limits, found, np.zeros(len(found)), 10.0)
    ).gaps.tolist()
    return corrected


def test_the_integral_adds_violations_and_stays_above_zero() -> None:
    integral = ViolationIntegral(0.25, 2)
    assert after(integral, 0.4, -1.0) == [0.5, -1.0]
    assert after(integral, 0.8, 2.0) == pytest.approx([1.1, 2.5])
    assert after(integral, -0.4, -4.0) == pytest.approx([-0.2, -4.0])


def test_a_violation_counts_no_more_than_its_bound() -> None:
    integral = ViolationIntegral(0.5, 2)
    assert after(integral, 7.0, 1.0, limit=2.0) == [8.0, 1.5]
    assert integral.values.tolist() == [1.0, 0.5]


def test_a_cost_without_a_limit_keeps_its_integral() -> None:
    integral = ViolationIntegral(0.5, 2)
    after(integral, 1.0, 1.0)
    assert after(integral, -math.inf, 1.0) == [-math.inf, 2.0]
    assert integral.values.tolist() == [0.5, 1.0]


def test_it_does_not_grow_after_a_step_that_did_not_meet_the_constraint() -> None:
    integral = ViolationIntegral(0.5, 2)
    after(integral, 1.0, 1.0)
    integral.note_step(BOTH, np.array([True, False]))
    assert after(integral, 1.0, 1.0) == [1.5, 2.0]
    integral.note_step(BOTH, np.array([True, False]))
    assert after(integral, -0.4, 0.2) == pytest.approx([-0.1, 1.3])


def test_a_restored_integral_goes_on_exactly() -> None:
    first, second = ViolationIntegral(0.3, 2), ViolationIntegral(0.3, 2)
    after(first, 1.0, 0.1)
    first.note_step(BOTH, np.array([True, False]))
    second.load_state_dict(first.state_dict())
    assert after(first, 0.7, 0.3) == after(second, 0.7, 0.3)


def test_a_limit_of_0_that_is_kept_forgets_old_violations() -> None:
    integral = ViolationIntegral(0.5, 1)
    after(integral, 2.0)
    assert integral.values.tolist() == [1.0]
    for expected in (0.5, 0.25):
        assert after(integral, 0.0, limit=0.0) == [expected]
    assert after(integral, 1e-9, limit=0.0) == pytest.approx(
        [0.125]
    )  # a life table's estimate only approaches 0


@pytest.mark.parametrize("mixed", [-2.0, -0.2, 0.0])
def test_a_constraint_is_unmet_if_no_step_of_the_trust_region_meets_it(mixed: float) -> None:
    # A step of length sqrt(2 * 0.5) = 1 along b, of length 2, decreases the cost by at most 2.
    for violation, expected in [(-5.0, False), (0.0, False), (1.9, False), (2.1, True)]:
        problem = StepProblem(1.0, np.array([mixed]), np.array([[4.0]]), np.array([violation]), 0.5)
        solution = solve_dual(problem)
        assert problem.unmet(solution).tolist() == [expected]
        assert (solution.case is StepCase.RECOVERY) == expected


def test_constraints_that_hinder_one_another_are_unmet_though_each_alone_could_be_met() -> None:
    gram = np.array([[1.0, -0.9], [-0.9, 1.0]])
    problem = StepProblem(1.0, np.zeros(2), gram, np.full(2, 0.1), 0.01)  # reach alone: sqrt(0.02) = 0.14
    solution = solve_dual(problem)
    assert problem.after(solution) == pytest.approx([0.0684, 0.0684], abs=1e-3)
    assert problem.unmet(solution).tolist() == [True, True]


def test_a_projected_step_that_was_scaled_back_leaves_its_constraint_unmet() -> None:
    problem = StepProblem(1.0, np.array([-0.9]), np.eye(1), np.array([0.13]), 0.01)
    solution = projected_step(problem)
    assert problem.after(solution) == pytest.approx([0.00222], abs=1e-5)  # alone, 0.13 is within reach
    assert problem.unmet(solution).tolist() == [True]


@pytest.mark.parametrize(("gain", "settled"), [(0.0, 0.6), (0.1, 0.0)])
def test_the_cost_settles_on_the_limit_where_only_half_the_predicted_fall_is_realised(
    gain: float, settled: float
) -> None:
    # Each update the rest of the step raises the cost by 0.3, unpredicted, and half the predicted fall comes
    # true: J' = J + 0.3 - (c + I) / 2. Without I the cost settles at c = 0.6.
    integral = ViolationIntegral(gain, 1)
    cost, limit = 3.0, 2.0
    for _ in range(400):
        problem = StepProblem(
            1.0,
            np.array([-1.0]),
            np.eye(1),
            np.array(after(integral, cost - limit)),
            50.0,
        )
        solution = solve_dual(problem)
        assert solution.case is StepCase.CONSTRAINED
        integral.note_step(BOTH[:1], problem.unmet(solution))
        predicted = problem.after(solution) - problem.violations
        cost += 0.3 + 0.5 * float(predicted[0])
    assert cost - limit == pytest.approx(settled, abs=1e-6)


@pytest.mark.parametrize("drift", [1.0, 3.0])
def test_the_cost_settles_on_the_limit_though_the_constraint_is_often_unreachable(drift: float) -> None:
    # As above, but the cost is measured with noise, and a step can lower it by 10 at most.
    generator = np.random.default_rng(5)
    integral = ViolationIntegral(0.03, 1)
    cost, limit, count = 60.0, 25.0, 5_000
    costs, recoveries = np.zeros(count), 0
    for update in range(count):
        measured = cost + generator.uniform(-15.0, 15.0)
        constraints = Constraints(np.full(1, limit), np.full(1, measured - limit), np.full(1, 9.0), 1.0)
        gap = integral.corrected(constraints).gaps
        problem = StepProblem(1.0, np.array([-1.0]), np.eye(1), gap, 50.0)
        solution = solve_dual(problem)
        lowest = replace(problem, violations=integral.without_cost(constraints).gaps)
        integral.note_step(BOTH[:1], lowest.unmet(solution))
        predicted = problem.after(solution) - problem.violations
        cost = max(cost + drift + 0.5 * float(predicted[0]), 0.0)
        costs[update] = measured
        recoveries += solution.case is StepCase.RECOVERY
    assert recoveries / count > 0.2
    assert costs[1_000:].mean() - limit == pytest.approx(0.0, abs=0.5)
