"""Differences between the two presets: all options of agents whose value in ``paper`` is not ours."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from recrl.agents.registry import AGENTS, agent_config


@dataclass(frozen=True)
class Deviation:
    """An option with different values in the presets.

    Attributes:
        option: name of the field.
        recommended: its value in this preset, as JSON.
        paper: likewise.
        agents: the agents with these values.
    """

    option: str
    recommended: str
    paper: str
    agents: tuple[str, ...]


def deviations() -> tuple[Deviation, ...]:
    """Return all deviations, in the order of the options."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for agent in AGENTS:
        ours, theirs = (options_of(agent, preset) for preset in ("recommended", "paper"))
        for option, value in ours.items():
            if value != theirs[option]:
                found.setdefault((option, json.dumps(value), json.dumps(theirs[option])), []).append(agent)
    return tuple(Deviation(*values, tuple(agents)) for values, agents in found.items())


def options_of(agent: str, preset: str) -> dict[str, Any]:
    """Return every option of an agent under a preset except the preset itself, as JSON values."""
    return agent_config(agent, {"preset": preset}).model_dump(mode="json", exclude={"preset"})


def table() -> str:
    """The deviations as a Markdown table."""
    rows = ["| field | `recommended` | `paper` | agents |", "|---|---|---|---|"]
    for each in deviations():
        agents = "all" if set(each.agents) == set(AGENTS) else ", ".join(each.agents)
        rows.append(f"| `{each.option}` | {each.recommended} | {each.paper} | {agents} |")
    return "\n".join(rows)
