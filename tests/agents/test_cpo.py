"""CPO's own rules: when it steps, how far, and what the line search accepts."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, Space

from recrl.agents.algorithms.cpo import ConstrainedPolicyOptimisation, acceptance
from recrl.agents.algorithms.own_options import CPOConfig
from recrl.agents.algorithms.pcpo import projected_step
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.experience import ActiveConstraints, Constraints, Experience
from recrl.agents.learning.policy_rule import improve_and_measure
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal
from recrl.agents.trust_region.cpo_dual import DualSolution, StepCase, StepProblem, solve_dual
from recrl.agents.trust_region.local_model import LocalModel, improvement
from recrl.environments.cmdp import Floats
from tests.agents.sampled import sampled

DELTA = 0.01
LENGTH = 10.0
SPACES = [Discrete(3), Box(-1.0, 1.0, (2,))]


def improve(
    space: Space[object], gaps: list[float], limits: list[float] | None = None
) -> tuple[dict[str, float], Floats, Floats]:
    """The metrics, and the policy's parameters before and after."""
    policy, batch, advantages = sampled(space)
    before = policy.parameters.to_numpy()
    constraints = Constraints(
        np.array(limits or [10.0, 10.0]),
        np.array(gaps),
        np.zeros(2),
        LENGTH,
    )
    rule = ConstrainedPolicyOptimisation(CPOConfig(target_kl=DELTA, violation_integral_gain=0.0), 2)
    experience = Experience.of(policy, batch, advantages, constraints)
    metrics = improve_and_measure(rule, policy, experience, np.random.default_rng(0))
    old = make_policy(
        3, space, NetworkArchitecture((8, 8), orthogonal), 0.1, torch.Generator().manual_seed(0)
    )
    rows = batch.unique_observations
    moved = old.distribution(rows).divergence(policy.distribution(rows))  # type: ignore[arg-type]
    metrics["kl"] = float(torch.dot(batch.observation_weights, moved))
    return metrics, before.astype(np.float64), policy.parameters.to_numpy().astype(np.float64)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize(
    ("gaps", "case"),
    [
        ([-9.0, -9.0], StepCase.UNCONSTRAINED),
        ([-0.1, -9.0], StepCase.CONSTRAINED),
        ([0.1, -9.0], StepCase.CONSTRAINED),
        ([9.0, -9.0], StepCase.RECOVERY),
    ],
)
def test_the_step_stays_in_the_trust_region_and_serves_its_case(
    space: Space[object], gaps: list[float], case: StepCase
) -> None:
    metrics, before, after = improve(space, gaps)
    assert StepCase(int(metrics["case"])) is case
    assert metrics["policy_steps"] == 1.0
    assert 0.0 < metrics["kl"] <= DELTA
    assert np.linalg.norm(after - before) == pytest.approx(metrics["step_norm"], rel=1e-3)
    assert metrics["surrogate_cost_0"] <= max(-gaps[0] / LENGTH, 0.0) + 1e-6
    if gaps[0] < 0.0:
        assert metrics["surrogate_reward"] >= 0.0
    else:
        assert metrics["surrogate_cost_0"] < 0.0


@pytest.mark.parametrize("space", SPACES)
def test_no_limit_gives_the_unconstrained_step(space: Space[object]) -> None:
    unlimited, _, after = improve(space, [-math.inf, -math.inf], [math.inf, math.inf])
    slack, _, expected = improve(space, [-100.0, -100.0])
    np.testing.assert_allclose(after, expected, atol=1e-6)
    assert unlimited["multiplier_0"] == slack["multiplier_0"] == 0.0


def test_violations_enter_in_cost_per_step() -> None:
    constraints = Constraints(
        np.array([25.0, math.inf, 1.0]), np.array([50.0, -math.inf, -0.5]), np.array([60.0, 0.0, 0.0]), 1000.0
    )
    active = ActiveConstraints.of(constraints)
    assert active.index.tolist() == [0, 2]
    assert active.violations.tolist() == pytest.approx([0.05, -0.0005])
    divided = active.divided_by(np.array([2.0, 3.0, 5.0]))
    assert divided.violations.tolist() == pytest.approx([0.025, -0.0001])


def test_multipliers_are_per_unit_of_cost() -> None:
    """Twice the cost and its limit: half the multiplier, and the same step."""

    def one_update(factor: float) -> dict[str, float]:
        policy, batch, advantages = sampled(SPACES[1])
        advantages[:, 1] *= factor
        constraints = Constraints(np.array([10.0, 10.0]), np.array([0.1 * factor, -9.0]), np.zeros(2), LENGTH)
        experience = Experience.of(policy, batch, advantages, constraints)
        rule = ConstrainedPolicyOptimisation(CPOConfig(target_kl=DELTA, violation_integral_gain=0.0), 2)
        return improve_and_measure(rule, policy, experience, np.random.default_rng(0))

    plain, twice = one_update(1.0), one_update(2.0)
    assert plain["multiplier_0"] > 0.0
    assert twice["multiplier_0"] == pytest.approx(plain["multiplier_0"] / 2.0)
    assert twice["step_norm"] == pytest.approx(plain["step_norm"])


@pytest.mark.parametrize("solve", [solve_dual, projected_step])
def test_a_cost_that_no_step_can_change_does_not_hide_another_one(
    solve: Callable[[StepProblem], DualSolution],
) -> None:
    """Its advantages do not vary, so in units of its spread its violation is 1e8 times that of others."""
    policy, batch, advantages = sampled(SPACES[1])
    advantages[:, 2] = 1.0
    constraints = Constraints(np.array([10.0, 10.0]), np.array([9.0, 300.0]), np.zeros(2), LENGTH)
    experience = Experience.of(policy, batch, advantages, constraints)
    config = CPOConfig(target_kl=DELTA, violation_integral_gain=0.0)
    rule = ConstrainedPolicyOptimisation(config, 2, solve)
    metrics = improve_and_measure(rule, policy, experience, np.random.default_rng(0))
    assert metrics["policy_steps"] == 1.0
    assert metrics["surrogate_cost_0"] < 0.0


def updates(gain: float, gap: float, count: int) -> list[dict[str, float]]:
    """The metrics of updates of one rule, each from the same samples and with the same gap of cost 0."""
    rule = ConstrainedPolicyOptimisation(CPOConfig(target_kl=DELTA, violation_integral_gain=gain), 2)
    constraints = Constraints(np.array([10.0, 10.0]), np.array([gap, -9.0]), np.zeros(2), LENGTH)
    metrics = []
    for _ in range(count):
        policy, batch, advantages = sampled(SPACES[1])
        experience = Experience.of(policy, batch, advantages, constraints)
        metrics.append(improve_and_measure(rule, policy, experience, np.random.default_rng(0)))
    return metrics


def test_the_step_decreases_the_cost_by_the_violation_plus_the_integral() -> None:
    violation = 0.05 / LENGTH
    [published] = updates(0.0, 0.05, 1)
    first, second = updates(1.0, 0.05, 2)
    assert published["violation_integral_0"] == 0.0
    assert first["violation_integral_0"] == pytest.approx(0.05)
    for metrics, multiple in ((published, 1.0), (first, 2.0), (second, 3.0)):
        assert StepCase(int(metrics["case"])) is StepCase.CONSTRAINED
        assert metrics["surrogate_cost_0"] == pytest.approx(-multiple * violation, rel=0.1)


def test_the_integral_is_at_most_the_limit_and_what_a_step_can_reach() -> None:
    metrics = updates(0.1, 9.0, 40)  # the limit is 10
    values = [each["violation_integral_0"] for each in metrics]
    assert values[:3] == pytest.approx([0.9, 1.8, 2.7])
    assert values[-1] == values[-2]
    assert StepCase(int(metrics[-1]["case"])) is StepCase.RECOVERY
    reach = -metrics[-1]["surrogate_cost_0"] * LENGTH  # of the true surrogate, after the line search
    assert values[-1] - 10.0 == pytest.approx(reach, rel=0.2)


def test_the_trust_region_bounds_the_divergence_of_the_new_policy_from_the_old() -> None:
    policy, batch, advantages = sampled(Box(-1.0, 1.0, (2,)))
    constraints = Constraints(np.full(2, 10.0), np.zeros(2), np.zeros(2), LENGTH)
    experience = Experience.of(policy, batch, advantages, constraints)
    model = LocalModel(policy, experience, advantages)
    policy.parameters.values[-2:] += 0.7  # the logarithms of the standard deviations
    policy.parameters.values[:-2] *= 1.1
    old, new = (
        torch.distributions.Normal(each.mean, each.log_std.exp())  # type: ignore[union-attr]
        for each in (experience.old, policy.distribution(batch.unique_observations))
    )
    expected = torch.distributions.kl_divergence(old, new).sum(1).mean()
    assert model.surrogates_and_divergence()[1] == pytest.approx(float(expected), rel=1e-5)


class Measured:
    """A model whose surrogates are 0 before the step, and given ones after it."""

    def __init__(self, after: list[float], divergence: float) -> None:
        self.after, self.divergence = np.array(after), divergence

    def old_surrogates(self) -> Floats:
        return np.zeros(3)

    def surrogates_and_divergence(self) -> tuple[Floats, float]:
        return self.after, self.divergence


def is_accepted(
    after: list[float], violations: list[float], *, recovered: tuple[int, ...] = (), divergence: float = DELTA
) -> bool:
    model, nothing = Measured(after, divergence), np.zeros(2)
    case = StepCase.RECOVERY if recovered else StepCase.CONSTRAINED
    solution = DualSolution(case, 0.0, nothing, nothing, recovered)
    active = ActiveConstraints(np.array([0, 1]), np.array(violations))
    return acceptance(model, active, solution, DELTA)()  # type: ignore[arg-type]


def test_a_step_is_accepted_if_the_reward_does_not_fall_and_the_costs_keep_their_limits() -> None:
    slack = [-0.2, -9.0]
    assert is_accepted([0.0, 0.2, 8.0], slack)
    assert not is_accepted([-0.001, 0.0, 0.0], slack)
    assert not is_accepted([1.0, 0.21, 0.0], slack)
    assert not is_accepted([1.0, 0.0, 0.0], slack, divergence=1.01 * DELTA)


def test_while_a_limit_is_violated_the_reward_may_fall_and_that_cost_may_not_rise() -> None:
    violated = [0.1, -0.2]
    assert is_accepted([-1.0, 0.0, 0.2], violated)
    assert not is_accepted([1.0, 0.001, 0.0], violated)
    assert not is_accepted([1.0, 0.0, 0.21], violated)


def test_recovery_is_accepted_by_the_recovered_costs_and_those_within_their_limits() -> None:
    assert is_accepted([-1.0, 5.0, -0.1], [0.1, 0.2], recovered=(1,))
    assert not is_accepted([1.0, -0.1, 0.1], [0.1, 0.2], recovered=(1,))
    assert not is_accepted([1.0, 0.3, -0.1], [-0.2, 0.2], recovered=(1,))


def test_crpos_step_is_accepted_if_what_it_is_for_does_not_get_worse() -> None:
    def accepted(after: list[float], corrected: int | None, divergence: float = DELTA) -> bool:
        return improvement(Measured(after, divergence), corrected, DELTA)()  # type: ignore[arg-type]

    assert accepted([0.0, 9.0, 9.0], None)
    assert not accepted([-0.001, -9.0, -9.0], None)
    assert accepted([-9.0, 9.0, 0.0], 1)
    assert not accepted([9.0, -9.0, 0.001], 1)
    assert not accepted([0.0, 0.0, 0.0], None, 1.01 * DELTA)
