"""The advantages and targets that an agent learns from, against a loop over its own critics' values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from recrl.agents.agent import Rollout
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.errors import DivergedError
from recrl.agents.learning.actor_critic import ActorCritic, _mean_squared_returns
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep, Floats
from recrl.environments.registry import make_vector

NUM_ENVS, NUM_STEPS, DISCOUNT = 3, 12, 0.9
DECAYS = np.array([0.5, 0.8, 0.8])


def learnt_agent(options: dict[str, Any]) -> tuple[ActorCritic, Rollout]:
    """An agent with trained critics, and a rollout in which episodes end in both ways."""
    environments = make_vector("two-state-2", NUM_ENVS)
    settings = {"discount": DISCOUNT, "reward_trace_decay": 0.5, "cost_trace_decay": 0.8, "hidden_sizes": [8]}
    agent = make_agent("ppo-lag", environments.cmdp, settings | options, np.random.SeedSequence(7))
    assert isinstance(agent, ActorCritic)
    collector, generator = Collector(environments, num_steps=NUM_STEPS), np.random.default_rng(2)
    collector.reset(seed=1)
    for _ in range(3):
        rollout, episodes = collector.collect(agent, generator)
        agent.update(rollout, episode_costs(episodes, 2), CurriculumStep(CostLimits((3.0, 3.0))))
    terminated, truncated = np.zeros((2, NUM_STEPS, NUM_ENVS), bool)
    terminated[[2, 7], [0, 1]] = True
    truncated[[4, 4, 9], [0, 2, 1]] = True
    final = rollout.observations[[0, 1, 2], [1, 2, 0]]
    return agent, replace(rollout, terminated=terminated, truncated=truncated, final_observations=final)


def values_of(agent: ActorCritic, observations: Any) -> Floats:
    """The critics' values in the task's units, [..., 3]."""
    rows = observations.reshape(-1, observations.shape[-1])
    state = agent.state_dict()["value_scale"]
    scales = np.sqrt(state["mean_squares"]) if agent._config.value_scale == "running" else np.ones(3)
    return (agent._critics.values(torch.as_tensor(rows)) * scales).reshape(*observations.shape[:-1], 3)


def by_a_loop(agent: ActorCritic, rollout: Rollout, decays: Floats) -> Floats:
    """The generalised advantages, sample by sample, forwards in time."""
    signals = np.concatenate([rollout.rewards[..., None], rollout.costs], axis=2)
    values, final = values_of(agent, rollout.observations), list(values_of(agent, rollout.final_observations))
    last = values_of(agent, rollout.last_observations)
    beyond = {tuple(place): final.pop(0) for place in np.argwhere(rollout.truncated)}
    found = np.zeros_like(signals)
    for start in range(NUM_STEPS):
        for env in range(NUM_ENVS):
            weight = np.ones(3)
            for step in range(start, NUM_STEPS):
                following = values[step + 1, env] if step + 1 < NUM_STEPS else last[env]
                if rollout.terminated[step, env]:
                    following = np.zeros(3)
                elif rollout.truncated[step, env]:
                    following = beyond[step, env]
                found[start, env] += weight * (signals[step, env] + DISCOUNT * following - values[step, env])
                if rollout.terminated[step, env] or rollout.truncated[step, env]:
                    break
                weight *= DISCOUNT * decays
    return found.reshape(-1, 3)


@pytest.mark.parametrize("value_target", ["lambda-return", "reward-to-go"])
@pytest.mark.parametrize("value_scale", ["running", "none"])
def test_advantages_and_targets_are_those_of_a_loop_over_the_steps(
    value_target: str, value_scale: str
) -> None:
    agent, rollout = learnt_agent({"value_target": value_target, "value_scale": value_scale})
    rows = rollout.observations.reshape(-1, rollout.observations.shape[-1])
    batch = LearningBatch.deduplicate(rows, rollout.actions.reshape(-1), compact=True)
    found = agent._estimate(rollout, rollout.costs, batch)
    values = values_of(agent, rollout.observations).reshape(-1, 3)
    advantages, returns = by_a_loop(agent, rollout, DECAYS), values + by_a_loop(agent, rollout, np.ones(3))
    np.testing.assert_allclose(found.advantages, advantages, rtol=1e-5, atol=1e-6)
    targets = values + advantages if value_target == "lambda-return" else returns
    np.testing.assert_allclose(found.targets, targets, rtol=1e-5, atol=1e-6)
    assert np.abs(advantages - by_a_loop(agent, rollout, np.full(3, 0.5))).max() > 0.01
    explained = 1.0 - (returns - values).var(axis=0) / returns.var(axis=0)
    measured = found.explained_variances()
    names = ("explained_variance_reward", "explained_variance_cost_0", "explained_variance_cost_1")
    assert [measured[name] for name in names] == pytest.approx(explained, rel=1e-4)


def test_a_new_scale_of_the_targets_leaves_the_values_as_they_are() -> None:
    agent, rollout = learnt_agent({})
    before, scale = values_of(agent, rollout.observations), agent._value_scale.values.copy()
    scaled, after = agent._scaled(np.full((5, 3), 100.0))
    assert (after > 2.0 * scale).all()
    np.testing.assert_allclose(scaled * after, 100.0)
    np.testing.assert_allclose(values_of(agent, rollout.observations), before, rtol=1e-5)


@pytest.mark.parametrize(("part", "name"), [("_network", "policy"), ("_critics", "critic")])
def test_parameters_that_are_not_finite_are_named(
    monkeypatch: pytest.MonkeyPatch, part: str, name: str
) -> None:
    agent, rollout = learnt_agent({})

    def diverge(*_: object) -> dict[str, float]:
        getattr(agent, part).parameters.values.fill_(np.nan)
        return {}

    monkeypatch.setattr(agent, "_learn", diverge)
    with pytest.raises(DivergedError, match=f"^{name} parameters must be finite"):
        agent.update(rollout, np.empty((0, 2)), CurriculumStep(CostLimits((3.0, 3.0))))


def test_the_first_scale_is_that_of_the_discounted_returns() -> None:
    signals = np.array([1.0, 2.0, 3.0])[:, None, None]
    ended = np.array([[False], [True], [False]])
    # With a discount of 0.5 the returns are 1 + 2 / 2, 2 and 3.
    assert _mean_squared_returns(signals, ended, 0.5) == pytest.approx([(4.0 + 4.0 + 9.0) / 3.0])


@pytest.mark.parametrize(("constraint", "own"), [("mean", {"constraint"}), ("cvar", set())])
def test_the_parts_of_a_state_have_their_names(constraint: str, own: set[str]) -> None:
    """Checkpoints of earlier versions are evaluated, too: a new name would make them unreadable."""
    agent, _ = learnt_agent({"constraint": constraint})
    parts = {"policy", "critics", "generator", "encoder", "average", "critic_optimiser", "value_scale"}
    assert set(agent.state_dict()) == parts | {"recent_episodes", "optimiser", "multipliers"} | own
