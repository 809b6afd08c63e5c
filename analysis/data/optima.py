"""J*(d_d) of a sweep's trials, if known."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from recrl.environments.plugins import UnknownNameError, UntrustedNameError
from recrl.environments.registry import optimal_return
from recrl.orchestrator.errors import USERS_ERRORS, described
from recrl.orchestrator.spec import TrialSpec

UNKNOWN_OPTIMUM = "the optimum is unknown here, because"
NO_OPTIMUM = "no optimum is known"


def optima_of(specs: Sequence[TrialSpec], *, finite: Collection[str]) -> tuple[list[float], list[str]]:
    """Return J*(d_d) of every trial, NaN if unknown, and a note for each task that is not installed.

    Args:
        specs: the trials.
        finite: labels of the tasks with recorded policy tables. The optimum of others is known nowhere.
    """
    optima: list[float] = []
    notes: dict[str, str] = {}

    def note(label: str, reason: str) -> str:
        return f"{label}: {UNKNOWN_OPTIMUM} {reason}" if label in finite else f"{label}: {NO_OPTIMUM}"

    for spec in specs:
        task = spec.task
        try:
            optimum = optimal_return(task.name, task.options, spec.deploy_limits)
        except (UnknownNameError, UntrustedNameError) as error:
            optimum = None
            notes[task.label] = note(task.label, str(error))
        except USERS_ERRORS as error:
            optimum = None
            notes[task.label] = note(task.label, described(error))
        optima.append(math.nan if optimum is None else optimum)
    return optima, list(notes.values())
