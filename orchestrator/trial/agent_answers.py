"""Checks of the numbers that an agent's methods return: an agent of the user's may return anything."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from recrl.orchestrator.errors import RowError

# Columns of some trials: of tasks with more costs, and of curricula that reward entropy. Tables of a sweep
# add which trial a row is from.
_RESERVED = re.compile(r"(cost|limit)_\d+|entropy_coefficient|trial|task|agent|method|seed")
_EVENT_KEYS = ("update", "end_step", "event", "policy_noise")


def checked_metrics(agent: str, metrics: object, columns: Collection[str]) -> Mapping[str, float]:
    """Return the metrics of an update: finite numbers or NaN, by name.

    Args:
        agent: its label.
        metrics: what ``update`` returned.
        columns: of the trial's own row, whose names are taken.

    Raises:
        RowError: they are something else; the sentence begins with the agent.
    """
    checked = _numbers(agent, "update", "metric", metrics)
    if taken := sorted(name for name in checked if name in columns or _RESERVED.fullmatch(name)):
        raise RowError(
            f"agent {agent}: its metrics must have other names than columns of a trial "
            f"or of a sweep's tables, got {', '.join(taken)}"
        )
    return checked


def checked_noise(agent: str, details: object) -> dict[str, Any]:
    """Return what ``add_noise`` says about the change, as JSON values: finite numbers by name.

    Raises:
        RowError: it is something else; the sentence begins with the agent.
    """
    checked = _numbers(agent, "add_noise", "number", details)
    for name, value in checked.items():
        if math.isnan(value):
            raise RowError(f"agent {agent}: number {name} of add_noise must be finite, got {value!r}")
    if taken := sorted(checked.keys() & set(_EVENT_KEYS)):
        raise RowError(f"agent {agent}: add_noise must not name {', '.join(taken)}; the event has these keys")
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in checked.items()}


def _numbers(agent: str, method: str, kind: str, values: object) -> Mapping[str, float]:
    if not isinstance(values, Mapping):
        raise RowError(f"agent {agent}: {method} must return a mapping of {kind}s, got {values!r}")
    for name, value in values.items():
        if not (isinstance(name, str) and name.isidentifier()):
            raise RowError(
                f"agent {agent}: the name of a {kind} must consist of letters, digits and _, and not begin "
                f"with a digit, got {name!r}"
            )
        if not _is_number(value):
            raise RowError(f"agent {agent}: {kind} {name} must be a finite number or NaN, got {value!r}")
    return values


def _is_number(value: object) -> bool:
    """Whether a value is a real number that is finite as a float, or NaN; True and False are not."""
    if isinstance(value, bool):
        return False
    try:
        return isinstance(value, int | float | np.integer | np.floating) and not math.isinf(value)
    except OverflowError:
        return False
