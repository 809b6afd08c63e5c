"""PPO-Lagrangian's own rules: multipliers, scaling, and what the policy climbs."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete

from recrl.agents.actor_critic import Constraints
from recrl.agents.advantages import scaled_advantages
from recrl.agents.agent import Rollout
from recrl.agents.batch import LearningBatch
from recrl.agents.config import PPOLagConfig
from recrl.agents.networks import NetworkForm, orthogonal
from recrl.agents.policies import StochasticPolicy
from recrl.agents.ppo_lag import PPOLagrangian
from recrl.environments.cmdp import Floats

STATES = np.array([0, 0, 1, 1, 1, 2])
ACTIONS = np.array([0, 1, 0, 1, 1, 0])
ADVANTAGES = np.array([[1.0, 2.0], [-1.0, 0.0], [2.0, 1.0], [0.0, 0.0], [-3.0, 1.0], [1.0, 2.0]])


def measured(gap: float, limit: float = 5.0) -> Constraints:
    return Constraints(np.array([limit]), np.array([gap]), 10.0)


def fresh(**options: object) -> tuple[StochasticPolicy, PPOLagrangian, LearningBatch]:
    generator = torch.Generator().manual_seed(0)
    policy = StochasticPolicy(3, Discrete(2), NetworkForm((8,), orthogonal), 1.0, generator)
    rule = PPOLagrangian(PPOLagConfig.model_validate(options), policy, 1)
    return policy, rule, LearningBatch.gather(np.eye(3, dtype=np.float32)[STATES], ACTIONS, compact=True)


def improved(gap: float, limit: float = 5.0, **options: object) -> dict[str, float]:
    policy, rule, batch = fresh(**options)
    return rule.improve(policy, batch, ADVANTAGES, measured(gap, limit))


def test_the_multiplier_answers_before_the_policy_moves() -> None:
    assert improved(10.0, multiplier_rule="projected", multiplier_step=0.02)["multiplier_0"] == 0.2


def test_without_a_finished_episode_the_multiplier_stays() -> None:
    policy, rule, batch = fresh(multiplier_initial=0.7)
    unknown = Constraints(np.array([5.0]), np.array([math.nan]), math.nan)
    assert rule.improve(policy, batch, ADVANTAGES, unknown)["multiplier_0"] == 0.7


@pytest.mark.parametrize("rule", ["projected", "softplus-adam", "pid"])
def test_no_limit_is_no_penalty(rule: str) -> None:
    metrics = improved(-math.inf, math.inf, multiplier_rule=rule, multiplier_initial=2.0)
    assert metrics["multiplier_0"] == 0.0


def test_a_reset_begins_the_multiplier_anew_only_when_the_limit_changes() -> None:
    options = {"multiplier_reset": True, "multiplier_rule": "projected", "multiplier_step": 0.1}
    policy, rule, batch = fresh(**options)
    found = [
        rule.improve(policy, batch, ADVANTAGES, measured(1.0, limit))["multiplier_0"]
        for limit in (5.0, 5.0, 4.0, 4.0)
    ]
    assert found == pytest.approx([0.1, 0.2, 0.1, 0.2])


def test_rewards_are_standardised_and_costs_scaled_as_the_form_says() -> None:
    raw = np.array([[1.0, 4.0], [5.0, 10.0]])
    rewards, costs = scaled_advantages(raw, "reward-scaled")
    assert (rewards.tolist(), costs.tolist()) == ([-1.0, 1.0], [[-1.5], [1.5]])
    assert scaled_advantages(raw, "centred")[1].tolist() == [[-3.0], [3.0]]


def test_equal_rewards_are_no_division_by_zero() -> None:
    rewards, _ = scaled_advantages(np.array([[1.0, 0.0], [1.0, 1.0]]), "reward-scaled")
    assert rewards.tolist() == [0.0, 0.0]


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


def penalised_gradient(penalty: str, multiplier: float) -> tuple[Floats, Floats]:
    """The objective's gradient by the logits of a tabular policy, and its finite differences."""
    _, rule, batch = fresh(penalty=penalty, cost_advantages="centred")
    objective = rule._objective(batch, ADVANTAGES, np.array([multiplier]))
    assert batch.decision_rows is not None
    rows = batch.rows.argmax(dim=1)[batch.decision_rows]
    start = torch.randn(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    old = torch.log_softmax(start - 0.1 * torch.eye(3, 2), dim=1)[rows, batch.actions].float()

    def value(logits: torch.Tensor) -> torch.Tensor:
        return objective((torch.log_softmax(logits, dim=1)[rows, batch.actions] - old).exp().float()).double()

    leaf = start.clone().requires_grad_()
    exact = torch.autograd.grad(value(leaf), leaf)[0].numpy()
    differences = np.zeros((3, 2))
    for place in np.ndindex(3, 2):
        change = torch.zeros(3, 2, dtype=torch.float64)
        change[place] = 1e-2
        differences[place] = float(value(start + change) - value(start - change)) / 2e-2
    return exact, differences


@pytest.mark.parametrize("penalty", ["combined", "separate"])
@pytest.mark.parametrize("multiplier", [0.0, 3.0])
def test_the_objectives_gradient_agrees_with_finite_differences(penalty: str, multiplier: float) -> None:
    exact, differences = penalised_gradient(penalty, multiplier)
    np.testing.assert_allclose(exact, differences, atol=2e-4)


def test_both_penalties_are_one_objective_before_anything_is_clipped() -> None:
    values = []
    for penalty in ("combined", "separate"):
        _, rule, batch = fresh(penalty=penalty)
        objective = rule._objective(batch, ADVANTAGES, np.array([2.0]))
        values.append(float(objective(1.0 + 0.1 * torch.arange(len(batch.actions)) / 10.0)))
    assert values[0] == pytest.approx(values[1], abs=1e-6)


def test_the_mean_length_of_episodes_is_bounded_by_the_horizon() -> None:
    zeros = np.zeros((10, 4))
    rollout = Rollout(zeros, zeros, zeros, zeros[..., None], zeros, zeros, zeros, zeros)  # type: ignore[arg-type]
    limits, one = np.array([1.0]), np.array([[3.0]])
    assert Constraints.measure(rollout, one, limits, None).episode_length == 40.0
    assert Constraints.measure(rollout, one, limits, 25).episode_length == 25.0
    assert Constraints.measure(rollout, one, limits, 25).gaps.tolist() == [2.0]
    assert not Constraints.measure(rollout, np.empty((0, 1)), limits, 25).known
