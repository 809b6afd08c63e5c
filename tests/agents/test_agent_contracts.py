"""What every agent promises, whatever its algorithm (``recrl.agents.agent.Agent``)."""

import copy
import gc
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from recrl.agents.agent import Agent, Rollout, learns_rewarded_entropy
from recrl.agents.algorithms.cpo import ConstrainedPolicyOptimisation
from recrl.agents.algorithms.own_options import CPOConfig
from recrl.agents.collection import Collector, FinishedEpisode, episode_costs
from recrl.agents.errors import DivergedError
from recrl.agents.learning.actor_critic import fresh_agent
from recrl.agents.learning.policy_rule import united
from recrl.agents.registry import AGENTS, agent_config, make_agent
from recrl.agents.shared_options import AscentConfig
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.checkpoint_format import decode, encode

TASKS = {"two-state": 3.0, "two-state-2": 3.0, "continuous-bandit": 2.5}
OPTIONS = {"hidden_sizes": [16, 16], "critic_steps": 5, "critic_passes": 1}
FINITE, SEVERAL_UPDATES = 3.0, 4


class Lessons:
    """An agent with its task, advanced update by update."""

    def __init__(self, agent: str, task: str, options: dict[str, Any] | None = None) -> None:
        environments = make_vector(task, 4)
        self.num_costs = environments.cmdp.num_costs
        self.agent: Agent = make_agent(
            agent, environments.cmdp, OPTIONS | (options or {}), np.random.SeedSequence(7)
        )
        self.collector = Collector(environments, num_steps=20)
        self.collector.reset(seed=1)
        self.generator = np.random.default_rng(2)

    def collect(self) -> tuple[Rollout, tuple[FinishedEpisode, ...]]:
        return self.collector.collect(self.agent, self.generator)

    def step(self, limit: float = FINITE, entropy_coefficient: float | None = None) -> CurriculumStep:
        return CurriculumStep(CostLimits((limit,) * self.num_costs), entropy_coefficient=entropy_coefficient)

    def update(self, limit: float = FINITE, entropy_coefficient: float | None = None) -> dict[str, float]:
        rollout, episodes = self.collect()
        costs = episode_costs(episodes, self.num_costs)
        return self.agent.update(rollout, costs, self.step(limit, entropy_coefficient))


@pytest.mark.parametrize("agent", AGENTS)
def test_a_deep_copy_goes_on_as_the_original_would(agent: str) -> None:
    lessons = Lessons(agent, "two-state")
    lessons.update()
    copied = copy.deepcopy(lessons)
    expected, found = ([it.update(), it.update()] for it in (lessons, copied))
    np.testing.assert_equal(found, expected)
    assert flattened(lessons.agent.state_dict()) == flattened(copied.agent.state_dict())


def without_an_end(rollout: Rollout) -> Rollout:
    """The steps of a rollout, as if none of them ended an episode."""
    never = np.zeros_like(rollout.terminated)
    return replace(
        rollout, terminated=never, truncated=never, final_observations=rollout.final_observations[:0]
    )


def flattened(tree: Any) -> list[Any]:
    """The leaves of a state, arrays as bytes."""
    if isinstance(tree, dict):
        return [leaf for key in sorted(tree) for leaf in (key, *flattened(tree[key]))]
    return [tree.tobytes() if isinstance(tree, np.ndarray) else tree]


every_agent = pytest.mark.parametrize("agent", AGENTS)
every_task = pytest.mark.parametrize("task", TASKS)


@pytest.mark.parametrize("name", ["policy", "generator", "average", "encoder"])
def test_a_rule_may_not_replace_a_part_of_its_agent(name: str) -> None:
    cmdp, config = make_vector("two-state", 1).cmdp, agent_config("cpo", {})
    assert isinstance(config, CPOConfig)
    rule = ConstrainedPolicyOptimisation(config, 1)
    rule.parts = {name: rule.parts["violation_integral"]}
    with pytest.raises(ValueError, match=f"other names than the agent's own, got {name}"):
        fresh_agent(cmdp, config, np.random.SeedSequence(0), lambda _: rule)


def test_a_rule_may_not_replace_a_metric_of_its_agent() -> None:
    assert united({"mine": 1.0}, {"kl": 0.1}) == {"mine": 1.0, "kl": 0.1}
    with pytest.raises(ValueError, match="other names than the agent's own, got kl"):
        united({"mine": 1.0, "kl": 0.0}, {"kl": 0.1})
    with pytest.raises(TypeError, match="a rule's improve must return a mapping of metrics, got None"):
        united(None, {"kl": 0.1})  # type: ignore[arg-type]


@every_agent
@every_task
def test_every_update_returns_the_same_metrics_and_no_infinity(agent: str, task: str) -> None:
    lessons = Lessons(agent, task)
    keys = set()
    for limit in (FINITE, math.inf, 0.0, 100.0):
        metrics = lessons.update(limit)
        assert not any(math.isinf(value) for value in metrics.values())
        keys.add(tuple(sorted(metrics)))
    rollout = without_an_end(lessons.collect()[0])
    none_finished = lessons.agent.update(rollout, np.empty((0, lessons.num_costs)), lessons.step())
    keys.add(tuple(sorted(none_finished)))
    assert len(keys) == 1
    for index in range(lessons.num_costs):
        reported = ("multiplier", "cost_gap", "cost_advantage_max", "value_loss_cost")
        assert {f"{name}_{index}" for name in reported} <= set(none_finished)
    assert {"kl", "entropy", "policy_steps", "surrogate_reward", "value_loss_reward"} <= set(none_finished)


@every_agent
@every_task
def test_resumed_is_uninterrupted_bit_for_bit(agent: str, task: str) -> None:
    lessons = Lessons(agent, task)
    for _ in range(SEVERAL_UPDATES):
        lessons.update()
    resumed = Lessons(agent, task)
    resumed.agent.load_state_dict(decode(encode(lessons.agent.state_dict()), source="memory"))
    for _ in range(SEVERAL_UPDATES):
        rollout, episodes = lessons.collect()
        costs = episode_costs(episodes, lessons.num_costs)
        expected = lessons.agent.update(rollout, costs, lessons.step())
        found = resumed.agent.update(rollout, costs, lessons.step())
        assert repr(found) == repr(expected)
    assert flattened(resumed.agent.state_dict()) == flattened(lessons.agent.state_dict())


@every_agent
def test_equal_seeds_give_equal_bytes(agent: str) -> None:
    first, second = Lessons(agent, "two-state"), Lessons(agent, "two-state")
    for lessons in (first, second):
        for _ in range(SEVERAL_UPDATES):
            lessons.update()
    assert flattened(first.agent.state_dict()) == flattened(second.agent.state_dict())


def test_every_agent_begins_with_the_same_policy() -> None:
    policies = [Lessons(agent, "two-state").agent.state_dict()["policy"] for agent in AGENTS]
    for policy in policies[1:]:
        np.testing.assert_array_equal(policy, policies[0])


@every_agent
@every_task
def test_the_state_is_a_copy(agent: str, task: str) -> None:
    lessons = Lessons(agent, task)
    state = lessons.agent.state_dict()
    before = flattened(state)
    lessons.update()
    assert flattened(state) == before


@every_agent
@every_task
def test_actions_have_the_shape_and_type_of_the_seam(agent: str, task: str) -> None:
    lessons = Lessons(agent, task)
    rollout, _ = lessons.collect()
    observations = rollout.observations[0]
    for actions in (
        lessons.agent.act(observations, np.random.default_rng(0)),
        lessons.agent.act_greedily(observations),
    ):
        gaussian = task == "continuous-bandit"
        assert actions.shape == ((4, 1) if gaussian else (4,))
        assert actions.dtype == np.dtype(np.float32 if gaussian else np.int64)


@every_agent
@every_task
def test_the_agent_knows_no_limit_of_its_own(agent: str, task: str) -> None:
    one, other = Lessons(agent, task), Lessons(agent, task)
    rollout, episodes = one.collect()
    costs = episode_costs(episodes, one.num_costs)
    one.agent.update(rollout, costs, one.step(1.0))
    other.agent.update(rollout, costs, other.step(2.0))
    one.agent.load_state_dict(other.agent.state_dict())
    assert repr(one.agent.update(rollout, costs, one.step(2.0))) == repr(
        other.agent.update(rollout, costs, other.step(2.0))
    )


@every_agent
@every_task
def test_noise_returns_the_same_metrics_and_keeps_the_agent_learning(agent: str, task: str) -> None:
    lessons = Lessons(agent, task)
    lessons.update()
    rollout, _ = lessons.collect()
    rows = rollout.observations.reshape(-1, rollout.observations.shape[-1])
    keys = {tuple(lessons.agent.add_noise(noise, rows)) for noise in (0.1, 1.0)}
    assert keys == {("noise_scale", "randomness_before", "randomness_after")}
    assert lessons.update()["kl"] > 0.0


@every_agent
@every_task
def test_entropy_that_is_rewarded_rises_in_that_update_alone(agent: str, task: str) -> None:
    plain, warm = (Lessons(agent, task, {"compaction": False}) for _ in range(2))
    for each in (plain, warm):
        assert learns_rewarded_entropy(each.agent)
        for _ in range(2):
            each.update()
    kept = 1000.0  # an agent that recovers from a violation looks at nothing else
    assert warm.update(kept, entropy_coefficient=1e4)["entropy"] > plain.update(kept)["entropy"]
    resumed = Lessons(agent, task, {"compaction": False})
    resumed.agent.load_state_dict(warm.agent.state_dict())
    rollout, episodes = warm.collect()
    costs = episode_costs(episodes, warm.num_costs)
    found, expected = (
        each.agent.update(rollout, costs, CurriculumStep(warm.step().limits, 0.0, coefficient))
        for each, coefficient in ((warm, 0.0), (resumed, None))
    )
    assert repr(found) == repr(expected)


@every_agent
def test_the_paper_preset_learns_with_the_same_metrics(agent: str) -> None:
    paper = Lessons(agent, "continuous-bandit", {"preset": "paper"})
    assert set(paper.update()) == set(Lessons(agent, "continuous-bandit").update())


@every_agent
def test_a_reward_that_is_not_a_number_is_named(agent: str) -> None:
    lessons = Lessons(agent, "two-state")
    rollout, episodes = lessons.collect()
    rewards = rollout.rewards.copy()
    rewards[0, 0] = math.nan
    with pytest.raises(DivergedError, match="rewards and costs must be finite, got 1 of 160 that are not"):
        lessons.agent.update(replace(rollout, rewards=rewards), episode_costs(episodes, 1), lessons.step())


@every_agent
def test_learning_that_diverges_is_an_error(agent: str) -> None:
    lessons = Lessons(agent, "two-state")
    state = lessons.agent.state_dict()
    state["critics"] = np.full_like(state["critics"], np.nan)
    lessons.agent.load_state_dict(state)
    with pytest.raises(DivergedError, match="must be finite, got"):
        lessons.update()


@every_agent
@pytest.mark.parametrize("task", ["two-state", "two-state-2"])
def test_evaluating_repeated_observations_once_changes_only_the_speed(agent: str, task: str) -> None:
    compact, plain = Lessons(agent, task), Lessons(agent, task, {"compaction": False})
    for _ in range(2):
        found, expected = compact.update(), plain.update()
        for key, value in expected.items():
            assert found[key] == pytest.approx(value, rel=2e-3, abs=2e-4, nan_ok=True), key


MINIBATCHES = {"compaction": False, "minibatch_size": 16, "critic_passes": 2}


@every_agent
@pytest.mark.parametrize("task", ["two-state-2", "continuous-bandit"])
def test_an_agent_of_minibatches_resumes_bit_for_bit(agent: str, task: str) -> None:
    has_metric = "metric_samples" in agent_config(agent, {}).model_dump()
    options = MINIBATCHES | ({"metric_samples": 20} if has_metric else {})
    lessons = Lessons(agent, task, options)
    for _ in range(2):
        lessons.update()
    resumed = Lessons(agent, task, options)
    resumed.agent.load_state_dict(decode(encode(lessons.agent.state_dict()), source="memory"))
    for _ in range(2):
        rollout, episodes = lessons.collect()
        costs = episode_costs(episodes, lessons.num_costs)
        expected = lessons.agent.update(rollout, costs, lessons.step())
        assert repr(resumed.agent.update(rollout, costs, lessons.step())) == repr(expected)
        if isinstance(agent_config(agent, options), AscentConfig):
            assert expected["policy_steps"] >= 1.0
    assert flattened(resumed.agent.state_dict()) == flattened(lessons.agent.state_dict())


@every_agent
def test_a_bound_on_the_worst_episodes_returns_the_same_metrics_and_resumes(agent: str) -> None:
    options = {"constraint": "cvar", "cvar_level": 0.5}
    lessons, resumed = (Lessons(agent, "two-state-2", options) for _ in range(2))
    assert set(lessons.update()) == set(Lessons(agent, "two-state-2").update())
    resumed.agent.load_state_dict(decode(encode(lessons.agent.state_dict()), source="memory"))
    rollout = without_an_end(lessons.collect()[0])
    none_finished = np.empty((0, 2))
    expected = lessons.agent.update(rollout, none_finished, lessons.step())
    assert repr(resumed.agent.update(rollout, none_finished, lessons.step())) == repr(expected)


def live_tensors() -> list[torch.Tensor]:
    """All tensors of the process."""
    gc.collect()
    return [thing for thing in gc.get_objects() if issubclass(type(thing), torch.Tensor)]


def held_bytes(others: list[torch.Tensor]) -> int:
    """What all live tensors take but for others."""
    known = set(map(id, others))
    return sum(tensor.nbytes for tensor in live_tensors() if id(tensor) not in known)


@pytest.mark.parametrize("agent", ["ppo-lag", "cpo"])
@pytest.mark.parametrize("options", [{}, MINIBATCHES])
def test_memory_is_flat_in_the_length_of_a_run(agent: str, options: dict[str, Any]) -> None:
    others = live_tensors()  # of earlier tests
    lessons = Lessons(agent, "continuous-bandit", options)
    lessons.update()
    saved, held = len(encode(lessons.agent.state_dict())), held_bytes(others)
    assert held > 0
    for _ in range(3):
        lessons.update()
    assert held_bytes(others) == held
    assert len(encode(lessons.agent.state_dict())) == pytest.approx(saved, abs=200)  # digits of numbers


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("activation", ["relu", "gelu"])
def test_networks_with_any_activation_begin_equal_on_a_gpu(activation: str) -> None:
    options = {"activation": activation}
    on_cpu = Lessons("ppo-lag", "two-state", options)
    with torch.device("cuda"):
        on_gpu = Lessons("ppo-lag", "two-state", options)
        on_gpu.update()
    with torch.device("cuda"):
        fresh = Lessons("ppo-lag", "two-state", options)
    np.testing.assert_array_equal(fresh.agent.state_dict()["policy"], on_cpu.agent.state_dict()["policy"])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@every_agent
@every_task
def test_an_agent_on_a_gpu_learns_what_one_on_a_cpu_learns(agent: str, task: str) -> None:
    on_cpu = Lessons(agent, task)
    with torch.device("cuda"):
        on_gpu = Lessons(agent, task)
    np.testing.assert_array_equal(on_gpu.agent.state_dict()["policy"], on_cpu.agent.state_dict()["policy"])
    rollout, episodes = on_cpu.collect()
    costs = episode_costs(episodes, on_cpu.num_costs)
    found, expected = (each.agent.update(rollout, costs, each.step()) for each in (on_gpu, on_cpu))
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=0.02, abs=1e-3, nan_ok=True), key
    on_cpu.agent.load_state_dict(on_gpu.agent.state_dict())
    observations = rollout.observations[0]
    np.testing.assert_array_equal(
        on_gpu.agent.act_greedily(observations), on_cpu.agent.act_greedily(observations)
    )


@every_agent
def test_no_update_lets_a_standard_deviation_fall_below_its_bound(agent: str) -> None:
    lessons = Lessons(agent, "continuous-bandit", {"min_std": 0.9})
    space = make_vector("continuous-bandit", 4).cmdp.action_space
    assert isinstance(space, Box)
    log_std = np.log(0.9 * min(1.0, (2.0 / space.shape[0]) ** 0.5) * np.ones(space.shape))
    least = float(log_std.sum()) + 0.5 * len(log_std) * math.log(2.0 * math.pi * math.e)
    for _ in range(SEVERAL_UPDATES):
        assert lessons.update()["entropy"] >= least - 1e-5


@pytest.mark.parametrize("agent", ["cpo", "pcpo", "crpo", "trpo", "trpo-lag"])
def test_a_standard_deviation_at_its_bound_takes_nothing_of_the_trust_region(agent: str) -> None:
    lessons = Lessons(agent, "continuous-bandit", {"min_std": 0.6, "target_kl": 0.005})
    for _ in range(8):
        lessons.update()
    for _ in range(4):  # without a limit the whole trust region is used
        metrics = lessons.update(math.inf)
        assert 0.98 * 0.005 < metrics["kl"] <= 0.005


@pytest.mark.parametrize("activation", ["relu", "elu", "gelu", "silu"])
def test_every_activation_learns_about_as_fast_as_tanh(activation: str) -> None:
    first, other = (Lessons("ppo-lag", "two-state", {"activation": each}) for each in ("tanh", activation))
    expected, found = (np.mean([each.update(math.inf)["kl"] for _ in range(5)]) for each in (first, other))
    assert 0.2 * expected < found < 5.0 * expected


class _Rewardless(Lessons):
    """A task without rewards: only the limit remains."""

    def collect(self) -> tuple[Rollout, tuple[FinishedEpisode, ...]]:
        rollout, episodes = super().collect()
        return replace(rollout, rewards=np.zeros_like(rollout.rewards)), episodes


@pytest.mark.parametrize("agent", ["ppo-lag", "trpo-lag", "focops", "p3o", "cpo"])
def test_costs_are_avoided_before_any_reward_was_seen(agent: str) -> None:
    lessons = _Rewardless(agent, "two-state")
    costs = []
    for _ in range(30):
        rollout, episodes = lessons.collect()
        costs.append(float(rollout.costs.mean()))
        lessons.agent.update(rollout, episode_costs(episodes, 1), lessons.step(0.5))
    assert np.mean(costs[-3:]) < 0.6 * np.mean(costs[:3])
