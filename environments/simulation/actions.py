"""Check continuous actions, and clip or refuse those outside their bounds."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt


class Actor(Protocol):
    """Environments that take actions."""

    def set_actions(self, actions: npt.NDArray[Any]) -> bool:
        """Take the actions of the next step; False if one is no number within the bounds."""


def give_actions(
    name: str,
    batch: Actor,
    actions: npt.NDArray[Any],
    *,
    shape: tuple[int, ...],
    bound: float,
    out_of_range: Literal["error", "clip"],
) -> None:
    """Set the actions of the next step.

    Args:
        name: the task's, for errors.
        batch: the environments.
        actions: one for each environment, or for the only one.
        shape: that the actions must have.
        bound: actions are within plus or minus this.
        out_of_range: what happens to others that are finite.

    Raises:
        ValueError: the actions mean nothing; the message says what is wrong with them.
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
    if out_of_range == "error":
        raise ValueError(
            f"{name}: actions must be in [{-bound:g}, {bound:g}], got {actions.tolist()} "
            "(option out_of_range: clip clips them)"
        )
    batch.set_actions(np.clip(actions, -bound, bound))
