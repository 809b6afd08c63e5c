"""The table of what the presets differ in is complete."""

import runpy
from pathlib import Path

from recrl.agents.registry import AGENTS

PRESETS = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "_ext" / "presets.py"))
deviations, options_of = PRESETS["deviations"], PRESETS["options_of"]


def test_paper_is_recommended_with_every_deviation_switched() -> None:
    for agent in AGENTS:
        switched = {
            each.option: options_of(agent, "paper")[each.option]
            for each in deviations()
            if agent in each.agents
        }
        assert {**options_of(agent, "recommended"), **switched} == options_of(agent, "paper")
        assert all(options_of(agent, "recommended")[option] != value for option, value in switched.items())
