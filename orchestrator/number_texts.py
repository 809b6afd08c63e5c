"""Numbers as text, for tables and captions."""

from __future__ import annotations

import math

DASH = "–"
ROUNDING = 1e-9  # a smaller size counts as 0


def number(value: float) -> str:
    """Format a value with suitable digits; a dash for NaN.

    Below 0.01 these are two significant digits. A zero has no minus.

    >>> [number(value) for value in (9.5, 128.44, 0.0312, 0.0, float("nan"))]
    ['9.50', '128.4', '0.031', '0.00', '–']
    >>> [number(value) for value in (0.00042, -0.002, 1.3e-5, -0.0, -1e-13)]
    ['0.00042', '-0.002', '1.3e-05', '0.00', '0.00']
    """
    if math.isnan(value):
        return DASH
    size = abs(value)
    if ROUNDING <= size < 0.01:
        return f"{value:.2g}"
    digits = 1 if size >= 100.0 else 3 if 0.01 <= size < 0.1 else 2
    return f"{value:z.{digits}f}"  # z: no -0.00


def with_error(mean: float, error: float, *, digits: int = 2) -> str:
    """Format mean ± standard error, without the error for a single seed.

    Args:
        mean: NaN becomes a dash.
        error: of the mean, or NaN.
        digits: after the point; one is enough from 100 on.

    >>> with_error(9.41, 0.05), with_error(9.41, float("nan")), with_error(-20.0, 0.0)
    ('9.41 ± 0.05', '9.41', '-20.00 ± 0.00')
    >>> with_error(5.002, 0.001, digits=3), with_error(-0.001, 0.012)
    ('5.002 ± 0.001', '0.00 ± 0.01')
    """
    if math.isnan(mean):
        return DASH
    shown = 1 if abs(mean) >= 100.0 else digits
    text = f"{mean:z.{shown}f}"  # z: no -0.00
    return text if math.isnan(error) else f"{text} ± {error:.{shown}f}"


def cost_with_error(mean: float, error: float, *, exact: bool) -> str:
    """Format the mean cost of policies as ``with_error`` does.

    An exact cost has three digits, because it is compared with a limit to within 1%. So has one near 0: a
    limit of 0 may be exceeded by 0.01.

    Args:
        mean: NaN becomes a dash.
        error: of the mean, or NaN.
        exact: whether the cost was computed, not sampled.

    >>> cost_with_error(5.002, 0.001, exact=True), cost_with_error(33.477, 7.471, exact=False)
    ('5.002 ± 0.001', '33.48 ± 7.47')
    >>> cost_with_error(0.0142, 0.0011, exact=False)
    '0.014 ± 0.001'
    """
    return with_error(mean, error, digits=3 if exact or abs(mean) < 0.1 else 2)
