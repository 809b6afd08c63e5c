"""Spaces of users' Gymnasium environments that agents handle."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
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
    with np.errstate(over="ignore"):  # bounds beyond float32 become infinite
        low, high = flat.low.astype(np.float32), flat.high.astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)


IntegerCheck = Callable[[Any], bool]


def integer_check(space: spaces.Space[Any]) -> IntegerCheck | None:
    """Return a test whether an observation's integers lie in their space; None if it has no integers.

    Flattening would change others without a word. The test raises AttributeError, IndexError, KeyError,
    TypeError or ValueError if the observation has another form.
    """
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = dict(space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces))
        checks = {key: check for key, part in parts.items() if (check := integer_check(part))}
        return functools.partial(_parts_lie_in, checks) if checks else None
    if isinstance(space, spaces.OneOf):
        return functools.partial(_chosen_lies_in, tuple(map(integer_check, space.spaces)))
    if isinstance(space, spaces.Discrete):
        return functools.partial(_lies_in, int(space.start), int(space.start + space.n - 1))
    bounds = _integer_bounds(space)
    return functools.partial(_lie_in, *map(np.ravel, bounds)) if bounds else None


def _integer_bounds(space: spaces.Space[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]] | None:
    """Return the least and the largest value of each integer of an array; None for other spaces."""
    if isinstance(space, spaces.MultiDiscrete):
        return space.start, space.start + space.nvec - 1
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape), np.ones(space.shape)
    if isinstance(space, spaces.Box) and space.dtype.kind in "biu":
        return space.low, space.high
    return None


def _parts_lie_in(checks: Mapping[Any, IntegerCheck], observation: Any) -> bool:
    return all(check(observation[key]) for key, check in checks.items())


def _chosen_lies_in(checks: Sequence[IntegerCheck | None], observation: Any) -> bool:
    index, chosen = observation
    if not 0 <= index < len(checks):
        return False
    check = checks[index]
    return check is None or check(chosen)


def _lies_in(low: int, high: int, value: Any) -> bool:
    """Whether one number is whole and within bounds, whatever its type."""
    if isinstance(value, int | np.integer):
        return bool(low <= value <= high)
    return _lie_in(np.array([low]), np.array([high]), value)


def _lie_in(low: npt.NDArray[Any], high: npt.NDArray[Any], values: Any) -> bool:
    """Whether numbers are whole and within bounds, whatever their type."""
    flat = np.ravel(values)
    if flat.shape != low.shape or not ((low <= flat) & (flat <= high)).all():
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
