"""Selection of trials by ``--only``: which arguments belong to it, its parsing, and the trials that match.

Imports almost nothing, so that ``--help`` is fast.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from recrl.orchestrator.errors import RecrlError

if TYPE_CHECKING:
    from recrl.orchestrator.spec import TrialSpec

SELECTABLE = ("task", "agent", "method", "seed")

# An argument KEY=VALUE; a path to a grid file that contains "=" is none.
PAIR = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*=.*(?<!\.yaml)(?<!\.yml)")


def number_of_pairs(rest: Sequence[str]) -> int:
    """Return how many of the arguments after a flag belong to its list of pairs.

    Args:
        rest: the arguments after it, at least one; the first belongs to the list in any case.

    >>> number_of_pairs(["method=none", "seed=0", "grid.yaml"])
    2
    """
    return next((i for i, it in enumerate(rest) if i and not PAIR.fullmatch(it)), len(rest))


def parse_only(pairs: Sequence[str]) -> dict[str, list[str]]:
    """Parse the arguments of ``--only`` to lists of values by key, as ``select`` takes them.

    Raises:
        RecrlError: a pair has no key or no value.

    >>> parse_only(["method=none,linear", "seed=0"])
    {'method': ['none,linear'], 'seed': ['0']}
    """
    wanted: dict[str, list[str]] = {}
    for pair in pairs:
        key, equals, values = pair.partition("=")
        if not equals or not values:
            raise RecrlError(f"--only: must look like method=dynamic or seed=0,1, got {pair!r}")
        wanted.setdefault(key, []).append(values)
    return wanted


def select(specs: Sequence[TrialSpec], wanted: Mapping[str, Sequence[str]]) -> tuple[TrialSpec, ...]:
    """Return the trials that match all conditions.

    Args:
        specs: the trials of the grid.
        wanted: acceptable labels (or seeds, as text) for some of ``SELECTABLE``; several in one text have
            commas between them, unless a label is that text.

    Raises:
        RecrlError: no trial of the grid has a given key or value, or none has all of them together.
    """
    from recrl.environments.plugins import nearest  # noqa: PLC0415

    accepted: dict[str, list[str]] = {}
    for key, texts in wanted.items():
        if key not in SELECTABLE:
            raise RecrlError(f"--only: trials are chosen by {', '.join(SELECTABLE)}, got {key!r}")
        known = list(dict.fromkeys(_label(spec, key) for spec in specs))
        accepted[key] = [it for text in texts for it in ([text] if text in known else text.split(","))]
        for value in accepted[key]:
            if value not in known:
                hint = nearest(value, known)
                raise RecrlError(f"--only: no trial has {key} {value!r}{hint} (known: {', '.join(known)})")
    chosen = tuple(
        spec for spec in specs if all(_label(spec, key) in values for key, values in accepted.items())
    )
    if accepted and not chosen:
        together = " and ".join(f"{key} {' or '.join(values)}" for key, values in accepted.items())
        raise RecrlError(f"--only: no trial has {together} together")
    return chosen


def _label(spec: TrialSpec, key: str) -> str:
    return str(spec.seed) if key == "seed" else str(getattr(spec, key).label)
