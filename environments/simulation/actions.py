"""Check continuous actions; clip those outside their bounds, as Safety Gym does."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt


class Actor(Protocol):
    """Environments that take actions."""

    def set_actions(self, actions: npt.NDArray[Any]) -> bool:
        """Set the actions of the next step; return False if one is not a number within the bounds."""


def give_actions(
    name: str,
    batch: Actor,
    actions: npt.NDArray[Any],
    *,
    shape: tuple[int, ...],
    bound: float,
) -> None:
    """Set the actions of the next step, clipped to their bounds.

    Args:
        name: the task's, for errors.
        batch: the environments.
        actions: one for each environment, or for the only one.
        shape: required shape of the actions.
        bound: actions are within plus or minus this.

    Raises:
        ValueError: the actions are invalid; the message says why.
    """
    actions = np.asarray(actions)
    if actions.shape != shape or actions.dtype.kind not in "fiu":
        raise ValueError(
            f"{name}: actions must be numbers of shape {shape}, got {actions.dtype} of shape {actions.shape}"
        )
    if batch.set_actions(actions):
        return
    if not np.isfinite(actions).all():
        raise ValueError(f"{name}: actions must be finite, got {actions.tolist()}")
    batch.set_actions(np.clip(actions, -bound, bound))
