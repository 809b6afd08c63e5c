"""Warnings about a grid before its trials run: tasks of unknown horizon, no deployment phase."""

from __future__ import annotations

from collections.abc import Sequence

from recrl.orchestrator.files.trial_warnings import no_deployment_sentence, unknown_horizon_sentence
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.spec import TrialSpec


def grid_warnings(grid: GridSpec, specs: Sequence[TrialSpec]) -> list[str]:
    """Return sentences on tasks of unknown horizon and on trials without an update in deployment.

    Args:
        grid: the checked grid.
        specs: those of its trials that are to run.
    """
    endless = [cell.task.label for cell in grid.tasks if cell.horizon is None]
    sentences = (unknown_horizon_sentence(endless), no_deployment_sentence(specs))
    return [sentence for sentence in sentences if sentence]
