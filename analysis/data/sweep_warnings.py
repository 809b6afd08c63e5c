"""Remarks on the validity of a sweep's numbers: damaged trials, other code, ineffective curricula."""

from __future__ import annotations

import json
from typing import Any

import pandas as pd

from recrl.analysis.data.labels import KEY
from recrl.analysis.data.sweep_data import Sweep, TrialFacts
from recrl.orchestrator.files.curriculum_warnings import (
    HARD_LANDING,
    hard_landing_sentence,
    landed_hard,
    no_curriculum_sentence,
)
from recrl.orchestrator.provenance.code_changes import other_code, other_code_sentence
from recrl.orchestrator.spec import TrialState


def damages(sweep: Sweep) -> list[str]:
    """Return a sentence for each damaged trial, whose data are not in the data frames."""
    return [f"{it.spec.title}: {it.error}" for it in sweep.facts if it.status is TrialState.DAMAGED]


def doubts(sweep: Sweep) -> list[str]:
    """Return sentences on trials that ran other code than is installed now, and on ineffective curricula."""
    changed = [it for it in sweep.facts if other_code(attempts(it), it.spec)]
    complete = sum(it.status is TrialState.COMPLETE for it in changed)
    code = other_code_sentence(complete, len(changed) - complete)
    return [*([code] if code else []), *curriculum_warnings(sweep)]


def curriculum_warnings(sweep: Sweep) -> list[str]:
    """Sentences on curricula that had no effect or ended far above d_d."""
    flags = curriculum_flags(sweep)
    said = (
        no_curriculum_sentence(_titles(flags, "no_curriculum")),
        hard_landing_sentence(_titles(flags, "hard_landing")),
    )
    return [sentence for sentence in said if sentence]


def curriculum_flags(sweep: Sweep) -> pd.DataFrame:
    """Say of each trial whether its curriculum had no effect or ended far above d_d.

    Returns:
        KEY, no_curriculum, hard_landing: a row a trial, in the order of the frame ``trials``.
    """
    facts = {it.spec.trial_id: it for it in sweep.facts}
    landed = sweep.events.loc[sweep.events["event"] == HARD_LANDING, list(KEY)]
    keys = set(landed.itertuples(index=False, name=None))
    flags = sweep.trials[list(KEY)].copy()
    trials = [facts[trial_id] for trial_id in sweep.trials["trial_id"]]
    flags["no_curriculum"] = [it.spec.is_no_curriculum(it.start_limits) for it in trials]
    flags["hard_landing"] = [
        landed_hard(it.spec, [HARD_LANDING] if key in keys else [])
        for it, key in zip(trials, flags[list(KEY)].itertuples(index=False, name=None), strict=True)
    ]
    return flags


def _titles(flags: pd.DataFrame, flag: str) -> list[str]:
    """The trials that have a flag, as people call them."""
    return [f"{it.task} {it.agent} {it.method} seed {it.seed}" for it in flags[flags[flag]].itertuples()]


def attempts(trial: TrialFacts) -> list[dict[str, Any]]:
    """Return the known provenance of each attempt; empty if no attempt began."""
    try:
        attempts = json.loads(trial.provenance).get("attempts", [])
    except (ValueError, AttributeError):
        return []
    return [attempt for attempt in attempts if isinstance(attempt, dict) and "code" in attempt]
