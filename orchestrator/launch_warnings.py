"""Warnings before trials run: unknown horizons, no deployment phase, trials left out."""

from __future__ import annotations

from collections.abc import Sequence

from recrl.orchestrator.counting import counted
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.launch_plan import Plan
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial_warnings import no_deployment_sentence, unknown_horizon_sentence


def grid_warnings(grid: GridSpec, specs: Sequence[TrialSpec]) -> list[str]:
    """Return sentences on tasks of unknown horizon and on trials without an update in deployment.

    Args:
        grid: the checked grid.
        specs: those of its trials that are to run.
    """
    endless = [cell.task.label for cell in grid.tasks if cell.horizon is None]
    return [*filter(None, (unknown_horizon_sentence(endless), no_deployment_sentence(specs)))]


def left_out_sentence(plan: Plan) -> str:
    """Return the sentence on trials that the grid no longer has; empty for none."""
    if not plan.orphans:
        return ""
    return (
        f"no longer in the grid: {counted(len(plan.orphans), 'trial')}, kept on disk and left out of results"
    )
