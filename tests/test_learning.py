"""Students reach the constrained optimum of tasks whose optimum is known, with the constraint binding."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from recrl.agents.collect import Collector, FinishedEpisode, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import make_vector, optimal_return

NUM_ENVS = 32


@dataclass(frozen=True)
class Lesson:
    """A task, a student, limits that bind, and how long to learn."""

    agent: str
    task: str
    limits: tuple[float, ...]
    updates: int
    options: dict[str, Any] = field(default_factory=dict)


LESSONS = [
    Lesson("ppo-lag", "two-state", (3.0,), 150),
    Lesson("cpo", "two-state", (3.0,), 80),
    Lesson("ppo-lag", "two-state-2", (5.0, 2.0), 150),
    Lesson("cpo", "two-state-2", (5.0, 2.0), 80),
    Lesson("ppo-lag", "continuous-bandit", (2.5,), 250),
    Lesson("cpo", "continuous-bandit", (2.5,), 80),
]


def last_quarter(lesson: Lesson, seed: int) -> tuple[float, np.ndarray[Any, Any]]:
    """Mean return and costs [k] of the episodes of the last quarter of learning."""
    environment_seed, agent_seed, policy_seed = np.random.SeedSequence(seed).spawn(3)
    environments = make_vector(lesson.task, NUM_ENVS)
    agent = make_agent(lesson.agent, environments.cmdp, lesson.options, agent_seed)
    collector = Collector(environments, num_steps=20)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    generator = np.random.default_rng(policy_seed)
    kept: list[FinishedEpisode] = []
    for update in range(lesson.updates):
        rollout, episodes = collector.collect(agent, generator)
        costs = episode_costs(episodes, len(lesson.limits))
        agent.update(rollout, costs, np.array(lesson.limits))
        if update >= 0.75 * lesson.updates:
            kept += episodes
    returns = [episode.episode_return for episode in kept]
    return float(np.mean(returns)), np.mean([episode.costs for episode in kept], axis=0)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("lesson", LESSONS, ids=lambda lesson: f"{lesson.agent}-{lesson.task}")
def test_a_student_reaches_the_constrained_optimum(lesson: Lesson, seed: int) -> None:
    optimum = optimal_return(lesson.task, {}, CostLimits(lesson.limits))
    unconstrained = optimal_return(lesson.task, {}, CostLimits.unlimited(len(lesson.limits)))
    assert optimum is not None and unconstrained is not None
    assert unconstrained > optimum + 1.0  # the constraint binds
    episode_return, costs = last_quarter(lesson, seed)
    assert np.all(costs <= np.array(lesson.limits) + 0.05)
    assert episode_return >= optimum - 0.1
