"""Performance profiles: for every return, the fraction of runs that are feasible and return more.

An infeasible run counts as worse than any return, and so does a failed trial. So lines may start below 1;
they never rise. The profile shows the whole distribution over runs: with five seeds, one run is a step of a
fifth. From Agarwal et al. 2021, figure 4. There is one panel per task and agent, so that returns of different
tasks need not be normalised.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from recrl.analysis.data.labels import occurring
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import panels, styles
from recrl.analysis.figures.styles import OPTIMUM_COLOUR, TEXT_WIDTH
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.intervals import performance_profile
from recrl.analysis.statistics.metrics import Measure
from recrl.analysis.statistics.verdicts import SOLVED_GAP
from recrl.environments.cmdp import Floats
from recrl.orchestrator.spec import TrialStatus


def performance_profiles(sweep: Sweep, measure: Measure) -> Figure | None:
    """Draw one row per task, one column per agent, one line per curriculum.

    Args:
        sweep: its complete and failed trials are drawn.
        measure: the outcome.

    Returns:
        The figure, or None if no trial is complete.
    """
    rows = metrics.outcomes(sweep)
    rows = rows[rows["measure"] == measure.value]
    if not len(rows):
        return None
    failed = sweep.trials[sweep.trials["status"] == TrialStatus.FAILED.value]
    look = styles.styles_of(sweep)
    ended = pd.concat([rows[["task", "agent"]], failed[["task", "agent"]]])
    tasks, agents = occurring(ended["task"]), occurring(ended["agent"])
    drawn = set()
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.5 * len(tasks) + 0.9), layout="constrained")
        grid = figure.subplots(len(tasks), len(agents), squeeze=False, sharex="row", sharey=True)
        for line, task in zip(grid, tasks, strict=True):
            chosen = rows[rows["task"] == task]
            thresholds = _thresholds(chosen)
            for axes, agent in zip(line, agents, strict=True):
                complete, lost = panels.rows_of(rows, task, agent), panels.rows_of(failed, task, agent)
                for method, style in look.items():
                    runs, num_failed = (
                        complete[complete["method"] == method],
                        (lost["method"] == method).sum(),
                    )
                    if len(runs) + num_failed:
                        drawn.add(method)
                        shares = performance_profile(feasible_scores(runs, failed=num_failed), thresholds)
                        axes.plot(
                            thresholds,
                            shares,
                            **style.line,
                            drawstyle="steps-post",
                            zorder=3.0 + bool(style.dashes),
                        )
                for optimum in sorted(set(chosen["optimal_return"].dropna())):
                    axes.axvline(optimum, color=OPTIMUM_COLOUR, linewidth=0.7, zorder=1.0)
                axes.set_ylim(-0.05, 1.05)
                axes.set_title(f"{task}, {agent}", loc="left", pad=3.0)
            line[0].set_ylabel("fraction of runs")
        for axes in grid[-1]:
            axes.set_xlabel("return")
        present = [method for method in look if method in drawn]
        panels.legend_above(
            figure,
            [Line2D([], [], **look[method].line, label=method) for method in present],
            most=panels.METHODS_A_LINE,
            title=f"{measure.description}:\nfraction of runs feasible and above a return (grey: optimum)",
            handlelength=3.2,
        )
    return figure


def feasible_scores(rows: pd.DataFrame, *, failed: int = 0) -> Floats:
    """Return the returns of runs, minus infinity for an infeasible run and for each failed trial, [n, 1].

    Args:
        rows: of ``metrics.outcomes``.
        failed: number of failed trials, which have no outcome.
    """
    scores = rows["episode_return"].where(rows["feasible"], -np.inf)
    return np.append(scores.to_numpy(np.float64), np.full(failed, -np.inf))[:, None]


def _thresholds(rows: pd.DataFrame) -> Floats:
    """Return all returns at which a line may fall, and the ends of the axis.

    The ends are around the optimum and the returns of feasible runs, or of all runs if none is feasible.
    Where all trials have failed, they are around 0.
    """
    shown = rows[rows["feasible"]] if rows["feasible"].any() else rows
    values = np.concatenate([shown["episode_return"], rows["optimal_return"]])
    values = values[np.isfinite(values)] if len(rows) else np.zeros(1)
    room = max(0.05 * float(values.max() - values.min()), SOLVED_GAP)
    return np.unique([values.min() - room, *shown["episode_return"], values.max() + room])
