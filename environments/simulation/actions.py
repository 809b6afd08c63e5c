"""Continuous actions on their way to the worlds that take them: given, clipped or refused."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt


class Orderable(Protocol):
    """Worlds that are told what to do next."""

    def order(self, actions: npt.NDArray[Any]) -> bool:
        """Take the actions; False if one is no number within the bounds."""


def give_actions(
    name: str,
    worlds: Orderable,
    actions: npt.NDArray[Any],
    *,
    shape: tuple[int, ...],
    bound: float,
    out_of_range: Literal["error", "clip"],
) -> None:
    """Give worlds their actions.

    Args:
        name: the task's, for errors.
        worlds: who acts.
        actions: what to do.
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
    if worlds.order(actions):
        return
    if not np.isfinite(actions).all():
        raise ValueError(f"{name}: actions must be finite, got {actions.tolist()}")
    if out_of_range == "error":
        raise ValueError(
            f"{name}: actions must be in [{-bound:g}, {bound:g}], got {actions.tolist()} "
            "(option out_of_range: clip clips them)"
        )
    worlds.order(np.clip(actions, -bound, bound))
