"""Spaces of users' Gymnasium environments that agents handle."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces


def float32_vectors(name: str, space: spaces.Space[Any]) -> spaces.Box:
    """Return the space of flattened observations, float32 [n].

    Raises:
        ValueError: they cannot be flattened.
    """
    flat = spaces.flatten_space(space)
    if not isinstance(flat, spaces.Box):
        raise ValueError(f"{name}: observations of {space} cannot be flattened to vectors")
    return spaces.Box(flat.low.astype(np.float32), flat.high.astype(np.float32), dtype=np.float32)


def supported_actions(name: str, space: spaces.Space[Any]) -> spaces.Box | spaces.Discrete:
    """Return an action space that agents handle: ``Discrete``, or a ``Box`` of m >= 1 floats.

    Raises:
        ValueError: it is another one.
    """
    if isinstance(space, spaces.Discrete) and space.start == 0:
        return space
    if (
        isinstance(space, spaces.Box)
        and np.issubdtype(space.dtype, np.floating)
        and len(space.shape) == 1
        and space.shape[0] > 0
    ):
        return space
    raise ValueError(
        f"{name}: actions must be Discrete from 0 or a Box of one dimension of floats, got {space}"
    )
