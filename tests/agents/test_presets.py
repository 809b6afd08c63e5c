"""The table of what the presets differ in is complete."""

from recrl.agents.presets import deviations, options_of
from recrl.agents.registry import AGENTS


def test_paper_is_recommended_with_every_deviation_switched() -> None:
    for agent in AGENTS:
        switched = {
            each.option: options_of(agent, "paper")[each.option]
            for each in deviations()
            if agent in each.agents
        }
        assert {**options_of(agent, "recommended"), **switched} == options_of(agent, "paper")
        assert all(options_of(agent, "recommended")[option] != value for option, value in switched.items())
