"""Numbers of things in sentences."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is one.

    >>> counted(1, "trial"), counted(12, "damaged trial")
    ('1 trial', '12 damaged trials')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"
