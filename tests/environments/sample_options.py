"""Options with which the tests make each registered task: the required ones, and short episodes."""

from __future__ import annotations

from typing import Any

from recrl.environments.registry import options_model

SHORT_HORIZON = 12
SAMPLES: dict[str, dict[str, Any]] = {
    "two-state": {"arrival": 0.5},
    "two-state-2": {"arrival": 0.5},
    "rivergrid-1a": {"horizon": 20, "costs": ("river", "turns")},
    "rivergrid-1b": {"horizon": 20},
    "rivergrid": {"horizon": 20, "map": "#######\n#>.~.G#\n#.%...#\n#######"},
    "rivergrid-generated": {"horizon": 20, "map_seed": 0},
    "gymnasium": {"id": "CartPole-v1", "costless": True},
}


def sample_options(name: str, **overrides: Any) -> dict[str, Any]:
    """Return the sample options of a task, with some of them replaced."""
    short = {"horizon": SHORT_HORIZON} if has_horizon(name) else {}
    return {**short, **SAMPLES.get(name, {}), **overrides}


def has_horizon(name: str) -> bool:
    """Return whether a task has the option ``horizon``."""
    return "horizon" in options_model(name).model_fields
