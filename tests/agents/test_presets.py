"""The table of what the presets differ in is complete."""

from recrl.agents.presets import deviations, options_of
from recrl.agents.registry import AGENTS


def test_paper_is_recommended_with_every_deviation_switched() -> None:
    for student in AGENTS:
        switched = {
            each.option: options_of(student, "paper")[each.option]
            for each in deviations()
            if student in each.agents
        }
        assert {**options_of(student, "recommended"), **switched} == options_of(student, "paper")
        assert all(options_of(student, "recommended")[option] != value for option, value in switched.items())
