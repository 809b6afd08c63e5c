"""Sweeps that earlier versions ran go on under this one: their trials are still the same trials."""

from pathlib import Path

import pytest

from recrl.agents.registry import AGENTS, agent_config
from recrl.analysis import compact
from recrl.orchestrator.grid import read_grid

PROJECT = Path(__file__).parent.parent
RESULTS = PROJECT / "results"
EXPORTS = {
    path: path.with_suffix(".zip")
    for path in sorted(RESULTS.glob("*/*.yaml"))
    if path.stem != "grid"  # it spells out defaults that have changed since
} | {PROJECT / "grids" / "safety-gym-small.yaml": RESULTS / "safety-gym" / "small.zip"}


@pytest.mark.parametrize("grid", EXPORTS, ids=lambda path: str(path.stem))
def test_a_new_option_makes_no_trial_another(grid: Path) -> None:
    """A trial is known by its options: those that came later are left out where they change nothing."""
    ran = {trial.spec.trial_id for trial in compact.load(EXPORTS[grid]).facts}
    assert ran == {spec.trial_id for spec in read_grid(grid).trials()}


@pytest.mark.parametrize("agent", AGENTS)
def test_an_option_that_is_left_out_is_there_where_it_is_set(agent: str) -> None:
    plain = agent_config(agent, {}).model_dump(mode="json")
    later = {"noisy_target_kl": 0.05, "limit_margin": 0.5} | ({"temperature": 0.5} if agent == "cpo" else {})
    assert not later.keys() & plain.keys()
    assert agent_config(agent, later).model_dump(mode="json") == plain | later
