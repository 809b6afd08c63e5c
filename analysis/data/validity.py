"""Remarks on the validity of a sweep's numbers: damaged trials, other code, ineffective curricula."""

from __future__ import annotations

import json
from typing import Any

from recrl.analysis.data.sweep_data import Sweep, TrialFacts
from recrl.orchestrator.files.code_changes import no_curriculum_sentence, other_code, other_code_sentence
from recrl.orchestrator.spec import TrialState


def damages(sweep: Sweep) -> list[str]:
    """Return a sentence for each damaged trial, whose data are not in the data frames."""
    return [f"{it.spec.title}: {it.error}" for it in sweep.facts if it.status is TrialState.DAMAGED]


def doubts(sweep: Sweep) -> list[str]:
    """Return sentences on trials that ran other code than is installed now, and on ineffective curricula."""
    changed = [it for it in sweep.facts if other_code(_attempts(it), it.spec)]
    complete = sum(it.status is TrialState.COMPLETE for it in changed)
    none = [it.spec.title for it in sweep.facts if it.spec.is_no_curriculum(it.start_limits)]
    said = (other_code_sentence(complete, len(changed) - complete), no_curriculum_sentence(none))
    return [sentence for sentence in said if sentence]


def _attempts(trial: TrialFacts) -> list[dict[str, Any]]:
    """Return the known provenance of each attempt; empty if no attempt began."""
    try:
        attempts = json.loads(trial.provenance).get("attempts", [])
    except (ValueError, AttributeError):
        return []
    return [attempt for attempt in attempts if isinstance(attempt, dict) and "code" in attempt]
