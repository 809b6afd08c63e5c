"""Agents reach the constrained optimum of tasks whose optimum is known, with the constraint binding."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from recrl.agents.collection import Collector, FinishedEpisode, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep, Floats
from recrl.environments.registry import make_vector, optimal_return


@dataclass(frozen=True)
class Lesson:
    """A task, an agent, limits that bind, how long to learn, and with how many seeds it is tested here.

    With no seed, a lesson is only in the table of ``tests/benchmarks/learning.py``. An agent steers by the
    mean cost of an update's episodes; who needs to know it better has more environments.
    """

    agent: str
    task: str
    limits: tuple[float, ...]
    updates: int
    options: dict[str, Any] = field(default_factory=dict)
    seeds: int = 1
    num_envs: int = 32


# The closed-form optimum is of a policy without noise.
NO_BOUND = {"min_std": 0.0}
LESSONS = [
    Lesson("ppo-lag", "two-state", (3.0,), 150),
    Lesson("cpo", "two-state", (3.0,), 80),
    Lesson("ppo-lag", "two-state-2", (5.0, 2.0), 150, num_envs=64),
    Lesson("cpo", "two-state-2", (5.0, 2.0), 80),
    Lesson("ppo-lag", "continuous-bandit", (2.5,), 500, options=NO_BOUND),
    Lesson("cpo", "continuous-bandit", (2.5,), 80, options=NO_BOUND),
    Lesson("trpo-lag", "two-state", (3.0,), 150),
    Lesson("trpo-lag", "two-state-2", (5.0, 2.0), 200),
    Lesson("trpo-lag", "continuous-bandit", (2.5,), 150, options=NO_BOUND),
    Lesson("pcpo", "two-state", (3.0,), 100),
    Lesson("pcpo", "two-state-2", (5.0, 2.0), 100),
    Lesson("pcpo", "continuous-bandit", (2.5,), 100, options=NO_BOUND),
    Lesson("focops", "two-state", (3.0,), 150),
    Lesson("focops", "two-state-2", (5.0, 2.0), 150, num_envs=128),
    Lesson("p3o", "two-state", (3.0,), 200),
    Lesson("p3o", "two-state-2", (5.0, 2.0), 200, num_envs=128),
    Lesson("ipo", "two-state", (3.0,), 200),
    Lesson("ipo", "two-state-2", (5.0, 2.0), 200, seeds=0),
    Lesson("crpo", "two-state", (3.0,), 100),
    Lesson("crpo", "two-state-2", (5.0, 2.0), 300, num_envs=128),
]


def last_quarter(lesson: Lesson, seed: int) -> tuple[float, Floats]:
    """Mean return and costs [k] of the episodes of the last quarter of learning."""
    environment_seed, agent_seed, policy_seed = np.random.SeedSequence(seed).spawn(3)
    environments = make_vector(lesson.task, lesson.num_envs)
    agent = make_agent(lesson.agent, environments.cmdp, lesson.options, agent_seed)
    collector = Collector(environments, num_steps=20)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    generator = np.random.default_rng(policy_seed)
    kept: list[FinishedEpisode] = []
    for update in range(lesson.updates):
        rollout, episodes = collector.collect(agent, generator)
        costs = episode_costs(episodes, len(lesson.limits))
        agent.update(rollout, costs, CurriculumStep(CostLimits(lesson.limits)))
        if update >= 0.75 * lesson.updates:
            kept += episodes
    returns = [episode.episode_return for episode in kept]
    return float(np.mean(returns)), np.mean([episode.costs for episode in kept], axis=0)


@pytest.mark.parametrize(
    ("lesson", "seed"),
    [
        pytest.param(lesson, seed, id=f"{lesson.agent}-{lesson.task}-{seed}")
        for lesson in LESSONS
        for seed in range(lesson.seeds)
    ],
)
def test_an_agent_reaches_the_constrained_optimum(lesson: Lesson, seed: int) -> None:
    optimum = optimal_return(lesson.task, {}, CostLimits(lesson.limits))
    unconstrained = optimal_return(lesson.task, {}, CostLimits.unlimited(len(lesson.limits)))
    assert optimum is not None and unconstrained is not None
    assert unconstrained > optimum + 1.0  # the constraint binds
    episode_return, costs = last_quarter(lesson, seed)
    assert np.all(costs <= np.array(lesson.limits) + 0.05)
    assert episode_return >= optimum - 0.1


@pytest.mark.parametrize("agent", ["ppo", "trpo"])
def test_a_control_reaches_the_unconstrained_optimum_whatever_the_limit(agent: str) -> None:
    optimum = optimal_return("two-state", {}, CostLimits.unlimited(1))
    assert optimum is not None
    episode_return, costs = last_quarter(Lesson(agent, "two-state", (3.0,), 80), seed=0)
    assert episode_return >= optimum - 0.1
    assert costs[0] == pytest.approx(9.0, abs=0.1)
