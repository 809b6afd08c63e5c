"""The integral of the violations: its arithmetic, its anti-wind-up, and the steady error that it removes."""

import math

import numpy as np
import pytest

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


def test_it_is_lowered_to_the_limit_and_the_mean_reach() -> None:
    integral = ViolationIntegral(0.5, 3)
    after(integral, 20.0, 8.0, 40.0)
    assert integral.values.tolist() == [10.0, 4.0, 20.0]
    integral.bound(np.array([0, 2]), np.array([1.0, 6.0]), np.array([10.0, 10.0]))
    assert integral.values.tolist() == [10.0, 4.0, 16.0]
    integral.bound(np.array([0, 2]), np.array([1.0, 6.0]), np.array([0.0, 5.0]))  # mean reach: 9 and 9.5
    assert integral.values.tolist() == [10.0, 4.0, 15.5]
    integral.bound(np.array([0]), np.array([0.0]), np.array([9.0]))
    assert integral.values.tolist() == [9.0, 4.0, 15.5]


def test_a_restored_integral_goes_on_exactly() -> None:
    first, second = ViolationIntegral(0.3, 2), ViolationIntegral(0.3, 2)
    after(first, 1.0, 0.1)
    first.bound(BOTH, np.zeros(2), np.array([0.2, 0.01]))
    second.load_state_dict(first.state_dict())
    assert after(first, 0.7, 0.3) == after(second, 0.7, 0.3)
    for each in (first, second):
        each.bound(BOTH, np.zeros(2), np.array([0.1, 0.02]))
    assert first.values.tolist() == second.values.tolist() == pytest.approx([0.19, 0.011])


def test_a_state_of_before_the_bound_loads() -> None:
    integral = ViolationIntegral(0.3, 2)
    integral.load_state_dict({"integral": np.array([3.0, 4.0]), "unmet": np.array([True, False])})
    integral.bound(BOTH, np.ones(2), np.ones(2))
    assert integral.values.tolist() == [2.0, 2.0]


def test_a_limit_of_0_that_is_kept_forgets_old_violations() -> None:
    integral = ViolationIntegral(0.5, 1)
    after(integral, 2.0)
    assert integral.values.tolist() == [1.0]
    for expected in (0.5, 0.25):
        after(integral, 0.0, limit=0.0)
        assert integral.values.tolist() == [expected]


def test_where_nothing_costs_the_integral_asks_for_nothing() -> None:
    integral = ViolationIntegral(0.5, 1)
    assert after(integral, 2.0, limit=1.0) == [2.5]
    assert after(integral, -0.9, limit=1.0) == pytest.approx([-0.85])
    integral = ViolationIntegral(0.5, 1)
    after(integral, 2.0, limit=1.0)
    assert after(integral, -1.0, limit=1.0) == [-1.0]


def test_a_known_cost_under_a_limit_of_0_counts() -> None:
    """Without a standard error nothing but the gap itself bounds what it adds."""
    integral = ViolationIntegral(0.5, 1)
    gaps = Constraints(np.zeros(1), np.full(1, 3.0), np.zeros(1), 10.0)
    assert integral.corrected(gaps).gaps.tolist() == [4.5]


@pytest.mark.parametrize("mixed", [-2.0, -0.2, 0.0])
def test_the_reach_is_the_largest_violation_that_a_step_can_correct(mixed: float) -> None:
    # A step of length sqrt(2 * 0.5) = 1 along b, of length 2, decreases the cost by at most 2.
    for violation, case in [(1.99, StepCase.CONSTRAINED), (2.01, StepCase.RECOVERY)]:
        problem = StepProblem(1.0, np.array([mixed]), np.array([[4.0]]), np.array([violation]), 0.5)
        assert problem.reach.tolist() == [2.0]
        assert solve_dual(problem).case is case


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
        predicted = problem.after(solution) - problem.violations
        cost += 0.3 + 0.5 * float(predicted[0])
    assert cost - limit == pytest.approx(settled, abs=1e-6)


def simulated(drift: float, limit: float, least: float, largest: float) -> tuple[float, ViolationIntegral]:
    """As above, with a reach that varies and costs like times between failures: violation and integral."""
    generator = np.random.default_rng(5)
    integral = ViolationIntegral(0.03, 1)
    cost, gaps, recoveries = limit + 5.0, np.zeros(5_000), 0
    for update in range(len(gaps)):
        gaps[update] = cost * generator.exponential() - limit
        constraints = Constraints(np.full(1, limit), gaps[update : update + 1], np.full(1, 30.0), 1.0)
        aims = integral.corrected(constraints).gaps
        reach = generator.uniform(least, largest)
        problem = StepProblem(1.0, np.array([-1.0]), np.eye(1), aims, 0.5 * reach**2)
        solution = solve_dual(problem)
        integral.bound(BOTH[:1], np.full(1, limit), problem.reach)
        predicted = problem.after(solution) - problem.violations
        cost = max(cost + drift + 0.5 * float(predicted[0]), 0.0)
        recoveries += solution.case is StepCase.RECOVERY
    assert recoveries > 0.35 * len(gaps)
    return float(gaps[1_000:].mean()), integral


def test_the_cost_settles_on_the_limit_though_many_steps_cannot_reach_their_aim() -> None:
    violation, _ = simulated(3.0, 5.0, 2.0, 18.0)
    assert violation == pytest.approx(0.0, abs=0.1)


def test_with_the_reach_of_a_single_update_it_would_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.agents.constraints.violation_integral.REACH_DECAY", 0.0)
    violation, _ = simulated(3.0, 5.0, 2.0, 18.0)
    assert violation > 0.5


def test_where_no_step_is_enough_the_integral_stops_at_its_bound() -> None:
    # The cost rises by 6 each update, and half of the reach of 10 is realised.
    violation, integral = simulated(6.0, 25.0, 10.0, 10.0)
    assert violation > 1_000.0
    assert integral.values.tolist() == pytest.approx([35.0])


def test_after_the_limit_has_fallen_the_integral_is_soon_within_its_new_bound() -> None:
    integral = ViolationIntegral(0.1, 1)
    for _ in range(200):
        after(integral, 50.0, limit=200.0)
        integral.bound(BOTH[:1], np.full(1, 200.0), np.full(1, 10.0))
    assert integral.values.tolist() == [210.0]
    after(integral, 5.0, limit=25.0)
    integral.bound(BOTH[:1], np.full(1, 25.0), np.full(1, 10.0))
    assert integral.values.tolist() == [35.0]
