"""Spaces of users' Gymnasium environments that agents handle."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
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


def integers_lie_in(space: spaces.Space[Any], observation: Any) -> bool:
    """Whether an observation's integers lie in its space; flattening would change others without a word.

    Numbers of floating-point boxes are not looked at.

    Raises:
        AttributeError, IndexError, KeyError, TypeError, ValueError: the observation has another form.
    """
    if isinstance(space, spaces.Dict):
        return all(integers_lie_in(part, observation[key]) for key, part in space.spaces.items())
    if isinstance(space, spaces.Tuple):
        return all(map(integers_lie_in, space.spaces, observation))
    if isinstance(space, spaces.OneOf):
        index, chosen = observation
        return 0 <= index < len(space.spaces) and integers_lie_in(space.spaces[index], chosen)
    bounds = _integer_bounds(space)
    return bounds is None or _are_integers(observation, *bounds)


def _integer_bounds(space: spaces.Space[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]] | None:
    """Return the least and the largest value of each integer; None for other spaces."""
    if isinstance(space, spaces.Discrete):
        return space.start, space.start + space.n - 1
    if isinstance(space, spaces.MultiDiscrete):
        return space.start, space.start + space.nvec - 1
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape), np.ones(space.shape)
    if isinstance(space, spaces.Box) and space.dtype.kind in "biu":
        return space.low, space.high
    return None


def _are_integers(values: Any, low: npt.NDArray[Any], high: npt.NDArray[Any]) -> bool:
    """Whether values are whole numbers within bounds, whatever their type."""
    flat, least, largest = np.ravel(values), np.ravel(low), np.ravel(high)
    if flat.shape != least.shape or not ((least <= flat) & (flat <= largest)).all():
        return False
    return flat.dtype.kind in "biu" or bool((flat == np.floor(flat)).all())


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
