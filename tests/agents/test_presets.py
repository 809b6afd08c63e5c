"""The table of what the presets differ in is complete, and is the README's."""

from pathlib import Path

from recrl.agents.presets import deviations, options_of, table
from recrl.agents.registry import AGENTS

README = Path(__file__).parents[2] / "README.md"


def test_paper_is_recommended_with_every_deviation_switched() -> None:
    for student in AGENTS:
        switched = {
            each.option: options_of(student, "paper")[each.option]
            for each in deviations()
            if student in each.agents
        }
        assert {**options_of(student, "recommended"), **switched} == options_of(student, "paper")
        assert all(options_of(student, "recommended")[option] != value for option, value in switched.items())


def test_the_readme_has_the_table() -> None:
    assert table() in README.read_text(encoding="utf-8")
