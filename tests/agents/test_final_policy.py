"""The final policy: a weighted mean of the policies after each update."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from recrl.agents.agent import Averaging, final_policy
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.learning.actor_critic import ActorCritic
from recrl.agents.registry import AGENTS, make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector

UPDATES = 4
STEP = CurriculumStep(CostLimits((5.0,)))


def learnt(
    name: str, task: str, options: dict[str, Any], updates: int
) -> tuple[ActorCritic, list[np.ndarray]]:
    """An agent after some updates, and the policy's parameters after each."""
    environments = make_vector(task, 4, options={"horizon": 10} if task == "two-state" else {})
    agent = make_agent(name, environments.cmdp, options, np.random.SeedSequence(1))
    assert isinstance(agent, ActorCritic)
    collector = Collector(environments, num_steps=20)
    collector.reset(seed=0)
    generator = np.random.default_rng(0)
    policies = []
    for _ in range(updates):
        rollout, finished = collector.collect(agent, generator)
        agent.update(rollout, episode_costs(finished, 1), STEP)
        policies.append(agent.state_dict()["policy"])
    return agent, policies


@pytest.mark.parametrize("decay", [0.5, 0.9])
def test_the_mean_has_geometric_weights(decay: float) -> None:
    agent, policies = learnt("ppo-lag", "two-state", {"policy_average": decay}, UPDATES)
    weights = decay ** np.arange(UPDATES - 1, -1, -1.0)
    expected = (weights / weights.sum()) @ np.array(policies, np.float64)
    np.testing.assert_allclose(agent.state_dict()["average"]["mean"], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", AGENTS)
def test_without_averaging_the_final_policy_is_the_last(name: str) -> None:
    agent, _ = learnt(name, "two-state", {"policy_average": 0.0}, UPDATES)
    observations = np.eye(2, dtype=np.float32)
    assert isinstance(agent, Averaging)
    assert np.array_equal(final_policy(agent).act_greedily(observations), agent.act_greedily(observations))
    assert np.array_equal(
        agent.final_policy().action_probabilities(observations), agent.action_probabilities(observations)
    )


def test_the_final_policy_acts_by_the_mean() -> None:
    agent, _ = learnt("ppo-lag", "continuous-bandit", {}, UPDATES)
    other, _ = learnt("ppo-lag", "continuous-bandit", {}, 1)
    state = agent.state_dict()
    other.load_state_dict({**state, "policy": state["average"]["mean"]})
    observations = np.random.default_rng(0).random((5, 1), np.float32)
    assert np.array_equal(agent.final_policy().act_greedily(observations), other.act_greedily(observations))
    assert not np.array_equal(
        agent.final_policy().act_greedily(observations), agent.act_greedily(observations)
    )


def test_averaging_does_not_change_training() -> None:
    _, with_average = learnt("ppo-lag", "two-state", {"policy_average": 0.9}, UPDATES)
    _, without = learnt("ppo-lag", "two-state", {"policy_average": 0.0}, UPDATES)
    assert np.array_equal(with_average, without)


def test_before_the_first_update_the_final_policy_is_the_first() -> None:
    agent, _ = learnt("ppo-lag", "two-state", {}, 0)
    observations = np.eye(2, dtype=np.float32)
    assert np.array_equal(
        agent.final_policy().action_probabilities(observations), agent.action_probabilities(observations)
    )


HOPPER = "SafetyHopperVelocity"
HOPPERS = np.random.default_rng(0).normal(size=(5, 11)).astype(np.float32)


def statistics(encoder: dict[str, Any]) -> np.ndarray:
    """Mean and variance of a saved encoder, [2, n]."""
    return np.stack([encoder["mean"], encoder["scatter"] / encoder["count"]])


def test_statistics_of_observations_are_averaged_like_parameters() -> None:
    seen = [learnt("ppo-lag", HOPPER, {"policy_average": 0.5}, updates)[0] for updates in (1, 2, 3)]
    first, second, last = (statistics(agent.state_dict()["encoder"]) for agent in seen)
    mean, variance = expected = (first + 2 * second + 4 * last) / 7
    state = seen[-1].state_dict()
    np.testing.assert_allclose(state["average"]["statistics"], expected, rtol=0, atol=1e-6)
    other, _ = learnt("ppo-lag", HOPPER, {}, 1)
    encoder = {"count": 1, "mean": mean, "scatter": variance}
    other.load_state_dict({**state, "policy": state["average"]["mean"], "encoder": encoder})
    averaged = seen[-1].final_policy()
    np.testing.assert_allclose(averaged.act_greedily(HOPPERS), other.act_greedily(HOPPERS), rtol=0, atol=1e-5)
    module = averaged.to_torch_module()
    np.testing.assert_allclose(
        module(torch.as_tensor(HOPPERS)).detach().clamp(-1, 1),
        averaged.act_greedily(HOPPERS),
        rtol=0,
        atol=1e-5,
    )
    other.load_state_dict({**state, "policy": state["average"]["mean"]})
    assert np.abs(averaged.act_greedily(HOPPERS) - other.act_greedily(HOPPERS)).max() > 1e-4


def test_without_averaging_the_statistics_are_the_last() -> None:
    agent, _ = learnt("ppo-lag", HOPPER, {"policy_average": 0.0}, UPDATES)
    assert np.array_equal(agent.final_policy().act_greedily(HOPPERS), agent.act_greedily(HOPPERS))


def test_an_older_state_without_averaged_statistics_has_those_of_its_encoder() -> None:
    agent, _ = learnt("ppo-lag", HOPPER, {}, UPDATES)
    state = agent.state_dict()
    del state["average"]["statistics"]
    older, _ = learnt("ppo-lag", HOPPER, {}, 1)
    older.load_state_dict(state)
    same, _ = learnt("ppo-lag", HOPPER, {}, 1)
    same.load_state_dict({**state, "policy": state["average"]["mean"]})
    assert np.array_equal(older.final_policy().act_greedily(HOPPERS), same.act_greedily(HOPPERS))


class FixedFeatures(torch.nn.Module):
    """A network with random numbers that are neither parameters nor buffers."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.features = (torch.randn(inputs, 4),)
        self.last = torch.nn.Linear(4, outputs)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        outputs: torch.Tensor = self.last(torch.tanh(rows @ self.features[0]))
        return outputs


def test_the_average_has_the_constants_of_a_users_network() -> None:
    options = {"policy_average": 0.0, "network": f"{__name__}:FixedFeatures"}
    agent, _ = learnt("ppo-lag", "two-state", options, UPDATES)
    observations = np.eye(2, dtype=np.float32)
    assert np.array_equal(
        agent.final_policy().action_probabilities(observations), agent.action_probabilities(observations)
    )
