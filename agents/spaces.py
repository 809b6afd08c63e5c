"""Supported spaces, and conversion of observations and actions between agents and tasks.

Observations become float32 rows: ``Discrete`` one-hot, ``Box``, ``MultiBinary`` and other arrays of numbers
flattened. Actions are ``Discrete`` (categorical policies) or ``Box`` (Gaussian policies).

Notation: B environments, n observation components, m action components.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Discrete, MultiBinary

from recrl.agents.errors import UnsupportedSpaceError
from recrl.environments.cmdp import Floats

UNBOUNDED = 1e30


def observation_size(space: gymnasium.Space[Any]) -> int:
    """Return the number of components of an observation row, n.

    Raises:
        UnsupportedSpaceError: the space is neither Discrete nor Box nor MultiBinary.
    """
    if isinstance(space, Discrete):
        return int(space.n)
    if isinstance(space, Box | MultiBinary):
        return math.prod(space.shape)
    raise UnsupportedSpaceError(f"observation space must be Discrete, Box or MultiBinary, got {space}")


def unbounded_numbers(space: gymnasium.Space[Any]) -> npt.NDArray[np.bool_]:
    """Return which components of an observation row lack a bound, [n].

    A bound of ``UNBOUNDED`` or beyond, such as the largest number of a type, is none.

    >>> unbounded_numbers(Box(np.float32([0.0, -np.inf]), np.float32([1.0, np.inf]))).tolist()
    [False, True]
    """
    if isinstance(space, Box):
        low, high = _flat_bounds(space)
        return (low <= -UNBOUNDED) | (high >= UNBOUNDED)
    return np.zeros(observation_size(space), np.bool_)


def _flat_bounds(space: Box) -> tuple[Floats, Floats]:
    """The lower and the upper bound of each component, [n] each."""
    low, high = (np.asarray(bound, np.float64).reshape(-1) for bound in (space.low, space.high))
    return low, high


def observation_rows(space: gymnasium.Space[Any], observations: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return B observations of ``space``, [B, ...], as float32 rows, [B, n].

    >>> observation_rows(Discrete(3), np.array([2, 0])).tolist()
    [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    """
    if isinstance(space, Discrete):
        rows = np.zeros((len(observations), int(space.n)), dtype=np.float32)
        rows[np.arange(len(observations)), observations - space.start] = 1.0
        return rows
    return np.asarray(observations, dtype=np.float32).reshape(len(observations), -1)


def action_size(space: gymnasium.Space[Any]) -> int:
    """Return the number of actions of a Discrete space, or of components, m, of a Box.

    Raises:
        UnsupportedSpaceError: the space is neither Discrete nor a Box of floats.
    """
    if isinstance(space, Discrete):
        return int(space.n)
    if isinstance(space, Box) and np.issubdtype(space.dtype, np.floating):
        return math.prod(space.shape)
    raise UnsupportedSpaceError(f"action space must be Discrete or a Box of floats, got {space}")


def action_range(space: Box) -> tuple[Floats, Floats]:
    """Return the middle of each action component's range and half its length, [m] each.

    They are the agent's zero and unit. With one bound the range has length 2 and begins there. Without bounds
    it is -1 to 1. A bound of ``UNBOUNDED`` or beyond, such as the largest number of a type, is none.

    >>> action_range(Box(np.float32([10.0, 5.0, -np.inf]), np.float32([20.0, np.inf, np.inf])))
    (array([15.,  6.,  0.]), array([5., 1., 1.]))
    """
    low, high = _flat_bounds(space)
    has_low, has_high = low > -UNBOUNDED, high < UNBOUNDED
    low, high = (
        np.where(has_low, low, np.where(has_high, high - 2.0, -1.0)),
        np.where(has_high, high, np.where(has_low, low + 2.0, 1.0)),
    )
    return 0.5 * (low + high), 0.5 * (high - low)


def environment_actions(space: gymnasium.Space[Any], actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert B actions of an agent, int64 [B] or float32 [B, m], to actions of the task.

    Discrete actions are shifted to the space's first one. Gaussian ones are in half ranges from the middle of
    the range, and the result is clipped to the bounds of the Box. The agent learns from the unclipped
    actions, whose density is known.
    """
    if isinstance(space, Discrete):
        shifted: npt.NDArray[Any] = (actions + space.start).astype(space.dtype, copy=False)
        return shifted
    assert isinstance(space, Box)
    if actions.shape[1:] != (math.prod(space.shape),):
        raise ValueError(
            f"an agent's actions must have shape (B, {math.prod(space.shape)}), got {actions.shape}"
        )
    middle, half = action_range(space)
    shaped = (middle + half * actions).reshape(len(actions), *space.shape)
    clipped: npt.NDArray[Any] = np.clip(shaped, space.low, space.high).astype(space.dtype)
    return clipped
