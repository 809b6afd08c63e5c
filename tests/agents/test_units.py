"""No setting of an agent knows the unit of a task's reward or cost.

Multiply all rewards, or all costs and limits, by 1,024, which is exact in floating point: the policies are
the same to the last bit. With 1,000 they are the same up to rounding.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from recrl.agents.collection import Collector, episode_costs
from recrl.agents.constraints.multiplier_rules import STARTS
from recrl.agents.registry import AGENTS, make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector

PENALTIES = ("p3o", "ipo")
LAGRANGIANS = [(agent, rule) for agent in ("ppo-lag", "trpo-lag", "focops") for rule in STARTS]
TRUST_REGIONS = ("cpo", "pcpo", "crpo")
LIMITS = {"two-state": 3.0, "continuous-bandit": 2.5}


def test_every_agent_under_a_limit_is_in_one_of_these_groups() -> None:
    assert {*PENALTIES, *TRUST_REGIONS, *(agent for agent, _ in LAGRANGIANS)} == set(AGENTS) - {"ppo", "trpo"}


def learnt(
    agent: str,
    task: str,
    options: dict[str, Any],
    *,
    reward: float = 1.0,
    cost: float = 1.0,
    updates: int = 6,
) -> npt.NDArray[np.float32]:
    """The actions' probabilities, or the modes, of an agent whose rewards and costs are multiplied."""
    environments = make_vector(task, 8)
    options = {"hidden_sizes": [16, 16], "critic_steps": 5, "critic_passes": 1, **options}
    learner = make_agent(agent, environments.cmdp, options, np.random.SeedSequence(7))
    collector, generator = Collector(environments, num_steps=40), np.random.default_rng(2)
    collector.reset(seed=1)
    step = CurriculumStep(CostLimits((cost * LIMITS[task],) * environments.cmdp.num_costs))
    for _ in range(updates):
        rollout, episodes = collector.collect(learner, generator)
        scaled = replace(
            rollout,
            rewards=reward * rollout.rewards,
            costs=cost * rollout.costs,
            carried_costs=cost * rollout.carried_costs,
        )
        learner.update(scaled, cost * episode_costs(episodes, environments.cmdp.num_costs), step)
    policy: npt.NDArray[np.float32] = learner.state_dict()["policy"]
    return policy


def options_of(rule: str) -> dict[str, Any]:
    return {
        "multiplier_rule": rule,
        "multiplier_initial": 0.5,
        "multiplier_step": 0.1,
        "multiplier_error_decay": 0.5,
    }


@pytest.mark.parametrize("task", LIMITS)
@pytest.mark.parametrize(("agent", "rule"), LAGRANGIANS)
def test_a_power_of_two_changes_no_bit(agent: str, rule: str, task: str) -> None:
    plain = learnt(agent, task, options_of(rule))
    assert learnt(agent, task, options_of(rule), reward=1024.0).tobytes() == plain.tobytes()
    assert learnt(agent, task, options_of(rule), cost=1024.0).tobytes() == plain.tobytes()


@pytest.mark.parametrize("task", LIMITS)
@pytest.mark.parametrize("agent", PENALTIES)
def test_a_power_of_two_changes_no_bit_of_a_penalty(agent: str, task: str) -> None:
    plain = learnt(agent, task, {})
    assert learnt(agent, task, {}, reward=1024.0).tobytes() == plain.tobytes()
    assert learnt(agent, task, {}, cost=1024.0).tobytes() == plain.tobytes()


@pytest.mark.parametrize("task", LIMITS)
@pytest.mark.parametrize("agent", TRUST_REGIONS)
def test_a_power_of_two_changes_no_bit_of_a_constrained_step(agent: str, task: str) -> None:
    plain = learnt(agent, task, {})
    for factor in (2.0**30, 2.0**-20):
        assert learnt(agent, task, {}, reward=factor).tobytes() == plain.tobytes()
        assert learnt(agent, task, {}, cost=factor).tobytes() == plain.tobytes()


@pytest.mark.parametrize(("agent", "rule"), LAGRANGIANS)
def test_a_thousand_changes_the_policy_by_rounding_only(agent: str, rule: str) -> None:
    plain = learnt(agent, "two-state", options_of(rule), updates=2)
    for units in ({"reward": 1000.0}, {"cost": 1000.0}, {"reward": 0.001}):
        assert learnt(agent, "two-state", options_of(rule), updates=2, **units) == pytest.approx(
            plain, abs=1e-3
        )
