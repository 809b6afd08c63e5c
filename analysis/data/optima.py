"""J*(d_d) of a sweep's trials, if known."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from pydantic import ValidationError

from recrl.environments.plugins import UnknownNameError, UntrustedNameError, WrongKindError
from recrl.environments.registry import optimal_return
from recrl.orchestrator.errors import USERS_ERRORS, described
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.validation_sentences import sentences

UNKNOWN_OPTIMUM = "the optimum is unknown here, because"
NO_OPTIMUM = "no optimum is known"


def optima_of(
    specs: Sequence[TrialSpec], labels: Sequence[str], *, finite: Collection[str]
) -> tuple[list[float], list[str]]:
    """Return J*(d_d) of every trial, NaN if unknown, and a note for each task that cannot be built here.

    Such a task is not installed, or its options are of another version.

    Args:
        specs: the trials.
        labels: of their tasks in the data frames.
        finite: labels of the tasks with recorded policy tables. The optimum of others is known nowhere.
    """
    optima: list[float] = []
    notes: dict[str, str] = {}
    for spec, label in zip(specs, labels, strict=True):
        try:
            optimum = optimal_return(spec.task.name, spec.task.options, spec.deploy_limits)
        except USERS_ERRORS as error:
            optimum = None
            reason = f"{UNKNOWN_OPTIMUM} {_reason(error)}" if label in finite else NO_OPTIMUM
            notes[label] = f"{label}: {reason}"
        optima.append(math.nan if optimum is None else optimum)
    return optima, list(notes.values())


def _reason(error: BaseException) -> str:
    if isinstance(error, UnknownNameError | UntrustedNameError | WrongKindError):
        return str(error)
    if isinstance(error, ValidationError):
        place, sentence = next(sentences(error, None))
        return f"this version cannot read its options: {'.'.join(map(str, place))}: {sentence}"
    return described(error)
