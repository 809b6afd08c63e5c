"""Check a task's output once per update, so that errors name the task and not the agent."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recrl.agents.agent import Rollout
from recrl.orchestrator.errors import RecrlError

Numbers = npt.NDArray[np.floating]


class TaskOutputError(RecrlError):
    """An environment returned an invalid observation, reward or cost."""


def check_rollout(rollout: Rollout, task: str) -> None:
    """Check that observations, rewards and costs are finite and that no cost is negative.

    Args:
        rollout: T steps of B environments.
        task: the task's label, for the message.

    Raises:
        TaskOutputError: they are not; the message has the value and its place.
    """
    per_step: dict[str, Numbers] = {
        "an observation": rollout.observations,
        "a reward": rollout.rewards,
        "a cost": rollout.costs,
    }
    for what, values in per_step.items():
        if not _are_finite(values):
            _complain(task, what, values, ~np.isfinite(values), "all must be finite")
    if rollout.costs.size and rollout.costs.min() < 0.0:
        _complain(task, "a cost", rollout.costs, rollout.costs < 0.0, "costs must be at least 0")
    ends = {"a last observation": rollout.final_observations, "an observation": rollout.last_observations}
    for what, values in ends.items():
        if not _are_finite(values):
            _complain(task, what, values, ~np.isfinite(values), "all must be finite", located=False)


def _are_finite(values: Numbers) -> bool:
    """Whether all are; the sum of finite numbers is finite unless they are huge, and faster to check."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum(dtype=np.float64))) or bool(np.isfinite(values).all())


def _complain(
    task: str,
    what: str,
    values: Numbers,
    bad: npt.NDArray[np.bool_],
    rule: str,
    *,
    located: bool = True,
) -> None:
    first = tuple(int(index) for index in np.argwhere(bad)[0])
    where = f" at step {first[0]} of the rollout in environment {first[1]}" if located else ""
    raise TaskOutputError(
        f"the task {task} returned {what} of {values[first]:g}{where} ({int(bad.sum())} of {values.size} "
        f"numbers); {rule}"
    )
