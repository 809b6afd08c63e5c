"""Finding agents by name, and their options and presets."""

import subprocess
import sys

import pytest
from pydantic import ValidationError

from recrl.agents.algorithms.own_options import CPOConfig, PPOLagConfig
from recrl.agents.registry import AGENTS, AgentEntry, agent_config, find_agent
from recrl.agents.shared_options import ActorCriticConfig
from recrl.environments.plugins import UnknownNameError
from recrl.teachers.registry import TeacherKind
from recrl.teachers.static import none_teacher


def test_validating_options_imports_no_torch() -> None:
    code = "import sys, recrl.agents.registry as r; r.agent_config('cpo', {}); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_an_unknown_agent_is_met_with_the_nearest_known() -> None:
    with pytest.raises(UnknownNameError, match=r"no agent is called 'ppo-lagg'; did you mean 'ppo-lag'\?"):
        find_agent("ppo-lagg")


def test_an_agents_import_path_must_lead_to_an_entry() -> None:
    with pytest.raises(ValueError, match="agent 'json:dumps' must be an AgentEntry, got function"):
        find_agent("json:dumps")


def test_an_import_path_finds_an_agents_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.agents.registry.MINE", AGENTS["cpo"], raising=False)
    assert find_agent("recrl.agents.registry:MINE") is AGENTS["cpo"]


@pytest.mark.parametrize("name", AGENTS)
def test_every_paper_value_is_an_option_and_is_valid(name: str) -> None:
    config = agent_config(name, {"preset": "paper"})
    assert isinstance(config, ActorCriticConfig)
    for option, value in config.paper.items():
        assert getattr(config, option) == value


def test_the_paper_preset_is_safety_starter_agents_setting() -> None:
    config = agent_config("ppo-lag", {"preset": "paper"})
    assert isinstance(config, PPOLagConfig)
    assert (config.discount, config.reward_trace_decay, config.cost_trace_decay) == (0.99, 0.97, 0.97)
    assert (config.hidden_sizes, config.critic_learning_rate, config.critic_steps) == ((256, 256), 1e-3, 80)
    assert (config.clip, config.policy_learning_rate, config.policy_steps) == (0.2, 3e-4, 80)
    assert config.stop_kl_factor * config.target_kl == pytest.approx(0.012)
    assert (config.multiplier_rule, config.multiplier_initial, config.multiplier_step) == (
        "softplus-adam",
        1.0,
        0.05,
    )
    cpo = agent_config("cpo", {"preset": "paper"})
    assert isinstance(cpo, CPOConfig)
    assert (cpo.damping, cpo.conjugate_gradient_steps) == (0.1, 10)
    assert (cpo.backtrack_ratio, cpo.backtrack_tries, cpo.target_kl) == (0.8, 10, 0.01)


def test_an_explicit_option_overrides_the_preset() -> None:
    config = agent_config("ppo-lag", {"preset": "paper", "policy_steps": 7})
    assert isinstance(config, PPOLagConfig)
    assert (config.policy_steps, config.critic_steps) == (7, 80)


def test_all_mistakes_are_reported_at_once() -> None:
    with pytest.raises(ValidationError) as caught:
        agent_config("ppo-lag", {"clip": 2.0, "discont": 0.9, "multiplier_rule": "sgd", "hidden_sizes": [0]})
    assert {error["loc"][0] for error in caught.value.errors()} == {
        "clip",
        "discont",
        "multiplier_rule",
        "hidden_sizes",
    }


def test_softplus_cannot_begin_at_zero() -> None:
    with pytest.raises(ValidationError, match=r"must be above 0 with the rule softplus-adam, got 0\.0"):
        agent_config("ppo-lag", {"multiplier_rule": "softplus-adam", "multiplier_initial": 0.0})


def test_an_entry_needs_a_model_of_options() -> None:
    with pytest.raises(TypeError, match=r"^options need a pydantic model, .*, got <class 'dict'>$"):
        AgentEntry("Mine.", dict, "mine:make")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^options need a pydantic model"):
        TeacherKind("Mine.", {}, none_teacher)  # type: ignore[arg-type]
