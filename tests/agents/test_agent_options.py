"""Every option of every agent reaches its learning, and an option without effect is an error."""

from __future__ import annotations

import functools
import json
import math
import re
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import AGENTS, agent_config, make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.plugins import IMPORT_PATH
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.checkpoint_format import encode

# For each option another value, and the options that it needs to matter.
OTHERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "activation": ("relu", {}),
    "backtrack_ratio": (0.1, {"backtrack_tries": 2}),
    "backtrack_tries": (1, {}),
    "barrier_sharpness": (0.01, {}),
    "barrier_slope": (0.1, {}),
    "clip": (0.001, {}),
    "compaction": (False, {"minibatch_size": 10}),
    "conjugate_gradient_steps": (1, {}),
    "constraint": ("cvar", {}),
    "constraint_window": (1, {}),
    "cost_surrogate": ("plain", {"clip": 0.001}),
    "cost_trace_decay": (0.1, {}),
    "critic_learning_rate": (0.1, {}),
    "critic_passes": (50, {}),
    "critic_steps": (1, {"critic_passes": 1}),
    "cvar_level": (0.1, {"constraint": "cvar"}),
    "damping": (5.0, {}),
    "discount": (0.5, {}),
    "entropy_bonus": (10.0, {}),
    "focops_lambda": (50.0, {}),
    "hidden_sizes": ([3], {}),
    "initialisation": ("xavier", {}),
    "kl_penalty": (1000.0, {"target_kl": 10.0}),
    "last_layer_scale": (1.0, {}),
    "metric_samples": (3, {"compaction": False}),
    "min_std": (0.9, {}),
    "minibatch_size": (10, {"compaction": False}),
    "multiplier_error_decay": (0.9, {}),
    "multiplier_initial": (3.0, {}),
    "multiplier_maximum": (0.001, {}),
    "multiplier_proportional": (0.0, {}),
    "multiplier_rule": ("projected", {}),
    "multiplier_step": (5.0, {}),
    "multiplier_unit": ("cost", {}),
    "noise_form": ("temperature", {}),
    "normalise_observations": ("all", {}),
    "penalty": ("separate", {"clip": 0.001}),
    "penalty_factor": (0.01, {}),
    "policy_average": (0.0, {}),
    "policy_learning_rate": (0.1, {}),
    "policy_passes": (50, {"target_kl": 10.0}),
    "policy_steps": (1, {"policy_passes": 1}),
    "preset": ("paper", {}),
    "reward_trace_decay": (0.1, {}),
    "stop_kl_factor": (1e-6, {}),
    "target_kl": (1e-6, {}),
    "tolerance": (100.0, {}),
    "trust_region": ("passed", {"target_kl": 1e-6}),
    "value_scale": ("none", {}),
    "value_target": ("reward-to-go", {}),
    "violation_integral_gain": (1.0, {}),
}
# They need a task with lidars, or a file of the user's: test_observation_features.py, test_module_stack.py.
ELSEWHERE = {"encoder", "proximity_scales", "network"}
TASKS = ("two-state-2", "continuous-bandit")
FEW_STEPS = {
    "hidden_sizes": [8],
    "critic_steps": 5,
    "critic_passes": 1,
    "policy_steps": 5,
    "policy_passes": 1,
}


def learnt(agent: str, task: str, options: dict[str, Any]) -> bytes:
    """The state of an agent after some updates, one of them with noise."""
    return _learnt(agent, task, json.dumps(options))


@functools.cache
def _learnt(agent: str, task: str, options_json: str) -> bytes:
    options = json.loads(options_json)
    environments = make_vector(task, 4)
    learner = make_agent(agent, environments.cmdp, options, np.random.SeedSequence(7))
    collector, generator = Collector(environments, num_steps=20), np.random.default_rng(2)
    collector.reset(seed=1)
    num_costs = environments.cmdp.num_costs
    for limit in (4.0, 0.5):
        rollout, episodes = collector.collect(learner, generator)
        if limit == 0.5:
            learner.add_noise(0.3, rollout.observations.reshape(-1, rollout.observations.shape[-1]))
        limits = CostLimits((limit,) * num_costs)
        learner.update(rollout, episode_costs(episodes, num_costs), CurriculumStep(limits))
    return encode(learner.state_dict())


@pytest.mark.parametrize("agent", AGENTS)
def test_another_value_of_an_option_gives_another_agent(agent: str) -> None:
    known = set(agent_config(agent, {}).model_dump())
    assert known <= ELSEWHERE | OTHERS.keys(), "give new options another value in OTHERS"
    without_effect = []
    for option in sorted(known - ELSEWHERE):
        value, needed = OTHERS[option]
        basis = {name: given for name, given in (FEW_STEPS | needed).items() if name in known}
        changed = basis | {option: value}
        if all(learnt(agent, task, basis) == learnt(agent, task, changed) for task in TASKS):
            without_effect.append(option)
    assert not without_effect


@pytest.mark.parametrize(
    ("agent", "options", "sentence"),
    [
        ("cpo", {"cvar_level": 0.5}, "cvar_level has no effect with constraint: mean: leave it out, got 0.5"),
        (
            "ppo-lag",
            {"multiplier_unit": "cost", "multiplier_error_decay": 0.9},
            "multiplier_error_decay has no effect with multiplier_unit: cost: leave it out, got 0.9",
        ),
        (
            "cpo",
            {"encoder": "none", "proximity_scales": [1.0]},
            "proximity_scales has no effect with encoder",
        ),
        (
            "ppo",
            {"network": "my.networks:make", "hidden_sizes": [8]},
            "hidden_sizes has no effect with a network",
        ),
        (
            "ppo-lag",
            {"multiplier_rule": "projected", "multiplier_proportional": 2.0},
            "multiplier_proportional has no effect with multiplier_rule: projected",
        ),
        (
            "ppo-lag",
            {"multiplier_rule": "softplus-adam", "multiplier_initial": 1.0, "multiplier_maximum": 2.0},
            "multiplier_maximum has no effect with multiplier_rule: softplus-adam",
        ),
        ("cpo", {"preset": "paper", "proximity_scales": [1.0]}, "proximity_scales has no effect"),
    ],
)
def test_an_option_without_effect_is_an_error(agent: str, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(sentence)):
        agent_config(agent, options)


@pytest.mark.parametrize("preset", ["recommended", "paper"])
@pytest.mark.parametrize("agent", sorted(AGENTS))
def test_the_full_options_of_an_agent_are_its_options(agent: str, preset: str) -> None:
    config = agent_config(agent, {"preset": preset})
    for mode in ("python", "json"):
        assert agent_config(agent, config.model_dump(mode=mode)) == config


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"critic_steps": True}, "must be a number, got true"),
        ({"minibatch_size": False}, "must be a number, got false"),
        ({"discount": True}, "must be a number, got true"),
        ({"hidden_sizes": [8, True]}, "must be a number, got true"),
    ],
)
def test_a_truth_value_is_no_number(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        agent_config("cpo", options)
    assert (
        agent_config("cpo", {"compaction": False, "minibatch_size": None}).model_dump()["compaction"] is False
    )


def test_the_paper_preset_of_crpo_has_its_sources_tolerance() -> None:
    assert agent_config("crpo", {"preset": "paper"}).model_dump()["tolerance"] == 0.5


def test_limits_and_episode_costs_must_fit_the_task_and_the_rollout() -> None:
    environments = make_vector("two-state-2", 4)
    agent = make_agent("cpo", environments.cmdp, {"hidden_sizes": [8]}, np.random.SeedSequence(7))
    collector = Collector(environments, num_steps=20)
    collector.reset(seed=1)
    rollout, episodes = collector.collect(agent, np.random.default_rng(2))
    costs, limits = episode_costs(episodes, 2), CostLimits((1.0, math.inf))
    with pytest.raises(ValueError, match="two-state-2: there must be one limit per cost, 2, got 1"):
        agent.update(rollout, costs, CurriculumStep(CostLimits((1.0,))))
    with pytest.raises(ValueError, match=f"one row for each episode .* {len(costs)}, got {len(costs) - 1}"):
        agent.update(rollout, costs[1:], CurriculumStep(limits))
    agent.update(rollout, costs, CurriculumStep(limits))


@pytest.mark.parametrize(
    ("path", "is_one"),
    [("my.networks:make", True), ("módulo:netz", True), ("m:A.b", False), ("m.:a", False), ("m:a\n", False)],
)
def test_a_network_is_an_import_path_like_those_of_tasks_and_agents(path: str, is_one: bool) -> None:
    assert is_one == bool(IMPORT_PATH.fullmatch(path))
    with nullcontext() if is_one else pytest.raises(ValueError, match="network"):
        agent_config("ppo", {"network": path})
