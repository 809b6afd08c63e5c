"""Limits that another curriculum would have set on recorded runs, against the limits in force.

One row per task and agent, one column per method of the sweep, one line per run. Infinite limits are left
out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from recrl.analysis.data.labels import AGENT_ORDER, METHOD_ORDER, ordered
from recrl.analysis.figures import panels, styles
from recrl.analysis.figures.styles import LIMIT_COLOUR, TEXT_WIDTH
from recrl.environments.cmdp import Phase
from recrl.orchestrator.spec import TrialSpec

REPLAYED_COLOUR = "#d5006d"
COST_COLOUR = "0.75"
MAX_COLUMNS = 5
DASHED = (0.0, (3.0, 1.2))


@dataclass(frozen=True, eq=False)
class Replayed:
    """A run and its replay under another curriculum.

    Attributes:
        spec: the run.
        rows: from ``curriculum_replay.replay``.
    """

    spec: TrialSpec
    rows: pd.DataFrame


def replayed_limits(runs: Sequence[Replayed], teacher: str, *, cost: int = 0) -> Figure:
    """Draw the figure.

    Args:
        runs: at least one.
        teacher: label of the other curriculum.
        cost: i, index of the cost and limit.
    """
    methods = ordered([run.spec.method.label for run in runs], METHOD_ORDER)
    agents = ordered([run.spec.agent.label for run in runs], AGENT_ORDER)
    tasks = ordered([run.spec.task.label for run in runs], ())
    present = {(run.spec.task.label, run.spec.agent.label) for run in runs}
    cells = [(task, agent) for task in tasks for agent in agents if (task, agent) in present]
    columns = min(MAX_COLUMNS, len(methods))
    lines = -(-len(methods) // columns)
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.3 * lines * len(cells) + 0.75), layout="constrained")
        grid = figure.subplots(lines * len(cells), columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
        for row, (task, agent) in enumerate(cells):
            for position, method in enumerate(methods):
                axes = grid[row * lines + position // columns, position % columns]
                chosen = [
                    run
                    for run in runs
                    if (run.spec.task.label, run.spec.agent.label) == (task, agent)
                    and run.spec.method.label == method
                ]
                if chosen:
                    axes.set_axis_on()
                    _panel(axes, chosen, cost)
                    axes.set_title(method)
            first = grid[row * lines, 0]
            first.set_axis_on()
            first.set_ylabel(f"{task}\n{agent}")
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        handles = [
            Line2D([], [], color=LIMIT_COLOUR, linewidth=1.1, label="limit in force"),
            Line2D(
                [], [], color=REPLAYED_COLOUR, linewidth=1.1, linestyle=DASHED, label=f"{teacher}'s limit"
            ),
            Line2D([], [], color=COST_COLOUR, linewidth=1.1, label="the agent's own cost"),
        ]
        title = f"limits that {teacher} would have set on the recorded episodes, a line a run"
        panels.legend_above(figure, handles, most=len(handles), title=title)
    return figure


def _panel(axes: Axes, runs: Sequence[Replayed], cost: int) -> None:
    highest = 0.0
    for run in runs:
        rows = run.rows[run.rows["phase"] == Phase.TRAINING.value]
        steps = rows["end_step"]
        axes.plot(steps, rows[f"cost_{cost}"], color=COST_COLOUR, linewidth=0.4, zorder=1.0)
        for name, colour, dashes in (
            (f"limit_{cost}", LIMIT_COLOUR, "-"),
            (f"replayed_limit_{cost}", REPLAYED_COLOUR, DASHED),
        ):
            values = rows[name].where(np.isfinite(rows[name]))
            highest = max(highest, float(values.max(skipna=True)) if values.notna().any() else 0.0)
            axes.plot(
                steps,
                values,
                color=colour,
                linestyle=dashes,
                linewidth=0.8,
                drawstyle="steps-pre",
                zorder=2.0,
            )
    boundary = float(runs[0].rows.loc[runs[0].rows["phase"] == Phase.TRAINING.value, "end_step"].max())
    panels.step_axis(axes, 0.0, boundary)
    axes.set_ylim(0.0, 1.15 * highest if highest > 0.0 else None)
