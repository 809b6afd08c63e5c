"""Warnings before trials run: unknown horizons, no deployment phase, other code, trials left out."""

from __future__ import annotations

from collections.abc import Sequence

from recrl.orchestrator.counting import counted
from recrl.orchestrator.files.trial_warnings import no_deployment_sentence, unknown_horizon_sentence
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.launch_plan import Plan
from recrl.orchestrator.provenance.code_changes import (
    missing_modules_sentence,
    other_code_sentence,
    other_versions_sentence,
)
from recrl.orchestrator.spec import TrialSpec, TrialStatus


def grid_warnings(grid: GridSpec, specs: Sequence[TrialSpec]) -> list[str]:
    """Return sentences on tasks of unknown horizon and on trials without an update in deployment.

    Args:
        grid: the checked grid.
        specs: those of its trials that are to run.
    """
    endless = [cell.task.label for cell in grid.tasks if cell.horizon is None]
    return [*filter(None, (unknown_horizon_sentence(endless), no_deployment_sentence(specs)))]


def code_warnings(plan: Plan) -> list[str]:
    """Return sentences on trials that ran other code or libraries than now, or code that is not found."""
    changed = plan.other_code
    complete = sum(trial.record.status is TrialStatus.COMPLETE for trial in changed)
    sentences = (
        other_code_sentence(complete, len(changed) - complete),
        missing_modules_sentence(plan.missing_modules),
        other_versions_sentence(plan.other_versions),
    )
    return [*filter(None, sentences)]


def left_out_sentence(plan: Plan) -> str:
    """Return the sentence on trials that the grid no longer has; empty for none."""
    if not plan.orphans:
        return ""
    return (
        f"no longer in the grid: {counted(len(plan.orphans), 'trial')}, kept on disk and left out of results"
    )
