"""The preset ``paper`` has the published values, and the table of the presets shows where ours differ."""

import runpy
from pathlib import Path
from typing import Any

import pytest

from recrl.agents.registry import AGENTS, agent_config

PRESETS = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "_ext" / "presets.py"))
deviations = PRESETS["deviations"]

STARTER_MULTIPLIERS = {
    "multiplier_rule": "softplus-adam",
    "multiplier_initial": 1.0,
    "multiplier_step": 0.05,
    "multiplier_unit": "cost",
}
PUBLISHED: dict[str, dict[str, Any]] = {
    # Ray et al. 2019, as in safety-starter-agents
    "ppo": {"clip": 0.2, "policy_learning_rate": 3e-4, "policy_steps": 80},
    "ppo-lag": {"clip": 0.2, "policy_learning_rate": 3e-4, "penalty": "separate", **STARTER_MULTIPLIERS},
    "trpo": {"target_kl": 0.01, "damping": 0.1, "conjugate_gradient_steps": 10, "backtrack_ratio": 0.8},
    "trpo-lag": {"target_kl": 0.01, "damping": 0.1, "kl_penalty": 0.0, **STARTER_MULTIPLIERS},
    "cpo": {"target_kl": 0.01, "damping": 0.1, "backtrack_tries": 10, "violation_integral_gain": 0.0},
    # Yang et al. 2020; the projection is in the metric of the KL
    "pcpo": {"target_kl": 0.01, "damping": 0.1, "violation_integral_gain": 0.0},
    # Zhang, Vuong and Ross 2020, appendix: lambda, the bound and the step of nu, and delta
    "focops": {
        "focops_lambda": 1.5,
        "multiplier_maximum": 2.0,
        "multiplier_step": 0.01,
        "multiplier_rule": "projected",
        "target_kl": 0.02,
    },
    "p3o": {"clip": 0.2, "penalty_factor": 20.0},  # Zhang et al. 2022: kappa
    "ipo": {"clip": 0.2, "barrier_sharpness": 20.0, "cost_surrogate": "plain"},  # Liu et al. 2020: t
    "crpo": {"tolerance": 0.5, "kl_penalty": 0.0},  # Xu et al. 2021: eta
}


@pytest.mark.parametrize("agent", AGENTS)
def test_the_preset_paper_has_the_published_values(agent: str) -> None:
    assert agent in PUBLISHED, f"give {agent} its published values in PUBLISHED"
    config = agent_config(agent, {"preset": "paper"}).model_dump()
    assert {option: config[option] for option in PUBLISHED[agent]} == PUBLISHED[agent]
    # of every agent: Ray et al. 2019
    assert (config["hidden_sizes"], config["activation"]) == ((256, 256), "tanh")
    assert (config["discount"], config["reward_trace_decay"]) == (0.99, 0.97)
    assert (config["critic_learning_rate"], config["critic_steps"]) == (1e-3, 80)


def test_the_table_of_the_presets_names_what_differs() -> None:
    rows = {(each.option, each.recommended, each.paper): each.agents for each in deviations()}
    assert rows["hidden_sizes", "[64, 64]", "[256, 256]"] == tuple(AGENTS)
    assert rows["penalty", '"combined"', '"separate"'] == ("ppo-lag",)
    assert rows["focops_lambda", "0.5", "1.5"] == ("focops",)
    assert rows["minibatch_size", "1024", "null"] == tuple(AGENTS)
    assert not [option for option, ours, theirs in rows if ours == theirs or option in ("preset", "clip")]
