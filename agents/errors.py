"""What can go wrong in an agent, named after the user's question."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt


class DivergedError(ArithmeticError):
    """Learning broke down: a loss, an advantage or a parameter is no longer a finite number."""


class NetworkError(ValueError):
    """A user's network that cannot be what the agent needs."""


class UnsupportedSpaceError(ValueError):
    """An observation or action space that the agents cannot handle."""


def require_finite(what: str, values: float | npt.NDArray[np.floating]) -> None:
    """Stop at the first non-finite number, and say where it is.

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
