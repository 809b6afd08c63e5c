"""How the two presets differ: every option of every agent whose value in ``paper`` is not ours."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from recrl.agents.registry import AGENTS, agent_config


@dataclass(frozen=True)
class Deviation:
    """One option that the presets set differently.

    Attributes:
        option: the field that switches it.
        recommended: its value there, as JSON.
        paper: likewise.
        agents: who have it with these values.
    """

    option: str
    recommended: str
    paper: str
    agents: tuple[str, ...]


def deviations() -> tuple[Deviation, ...]:
    """All of them, in the order of the options."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for agent in AGENTS:
        ours, theirs = (options_of(agent, preset) for preset in ("recommended", "paper"))
        for option, value in ours.items():
            if value != theirs[option]:
                found.setdefault((option, json.dumps(value), json.dumps(theirs[option])), []).append(agent)
    return tuple(Deviation(*values, tuple(agents)) for values, agents in found.items())


def options_of(agent: str, preset: str) -> dict[str, Any]:
    """Every option of an agent under a preset but the preset itself, as JSON values."""
    return agent_config(agent, {"preset": preset}).model_dump(mode="json", exclude={"preset"})


def table() -> str:
    """The deviations as a Markdown table."""
    rows = ["| field | `recommended` | `paper` | agents |", "|---|---|---|---|"]
    for each in deviations():
        agents = "all" if set(each.agents) == set(AGENTS) else ", ".join(each.agents)
        rows.append(f"| `{each.option}` | {each.recommended} | {each.paper} | {agents} |")
    return "\n".join(rows)
