"""Errors of agents."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt


class DivergedError(ArithmeticError):
    """Learning diverged: a loss, an advantage or a parameter is not a finite number."""


class NetworkError(ValueError):
    """A user's network that does not meet the requirements."""


class UnsupportedSpaceError(ValueError):
    """An observation or action space that the agents cannot handle."""


def require_finite(what: str, values: float | npt.NDArray[np.floating]) -> None:
    """Raise an error if a number is not finite.

    Args:
        what: plural name of the values for the message, for example ``policy parameters``.
        values: a number or an array of any shape.

    Raises:
        DivergedError: one of the values is infinite or not a number.
    """
    if isinstance(values, float):
        if math.isfinite(values):
            return
        raise DivergedError(f"{what} must be finite, got {values}")
    if not np.isfinite(values).all():
        bad = int(values.size - np.count_nonzero(np.isfinite(values)))
        raise DivergedError(f"{what} must be finite, got {bad} of {values.size} that are not")
