"""Performance profiles: for every return, the share of a method's runs that are above it.

The profile shows the whole distribution over runs where a mean shows one number: with five seeds, one that
failed is a step of a fifth. Agarwal et al. 2021, figure 4; here a panel a task and student, so that returns
of different tasks need not be normalised.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from recrl.analysis.data.labels import occurring
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import styles
from recrl.analysis.figures.styles import OPTIMUM_COLOUR, TEXT_WIDTH
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.intervals import performance_profile
from recrl.analysis.statistics.metrics import Measure

THRESHOLDS = 400


def performance_profiles(sweep: Sweep, measure: Measure) -> Figure | None:
    """A row a task, a column a student, a line a method.

    Args:
        sweep: its complete trials are drawn.
        measure: which outcome.

    Returns:
        The figure, or None if no trial is complete.
    """
    rows = metrics.outcomes(sweep)
    rows = rows[rows["measure"] == measure.value]
    if not len(rows):
        return None
    look = styles.method_styles(list(sweep.trials["method"].cat.categories))
    tasks, agents = occurring(rows["task"]), occurring(rows["agent"])
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.5 * len(tasks) + 0.6), layout="constrained")
        grid = figure.subplots(len(tasks), len(agents), squeeze=False, sharex="row", sharey=True)
        for line, task in zip(grid, tasks, strict=True):
            chosen = rows[rows["task"] == task]
            low, high = float(chosen["episode_return"].min()), float(chosen["episode_return"].max())
            room = 0.05 * (high - low) or 1.0
            thresholds = np.linspace(low - room, high + room, THRESHOLDS)
            for axes, agent in zip(line, agents, strict=True):
                for method, style in look.items():
                    runs = chosen[(chosen["agent"] == agent) & (chosen["method"] == method)]
                    if len(runs):
                        scores = runs["episode_return"].to_numpy(np.float64)[:, None]
                        shares = performance_profile(scores, thresholds)
                        axes.plot(thresholds, shares, **style.line, zorder=3.0 + bool(style.dashes))
                for optimum in sorted(set(chosen["optimal_return"].dropna())):
                    axes.axvline(optimum, color=OPTIMUM_COLOUR, linewidth=0.7, zorder=1.0)
                axes.set_title(f"{task}, {agent}", loc="left", pad=3.0)
            line[0].set_ylabel("share of runs above")
        for axes in grid[-1]:
            axes.set_xlabel("return")
        present = [method for method in look if (rows["method"] == method).any()]
        figure.legend(
            handles=[Line2D([], [], **look[method].line, label=method) for method in present],
            loc="outside upper center",
            ncols=len(present),
            handlelength=3.2,
            title=f"performance profiles of {measure.description}; grey: the optimum, where it is known",
        )
    return figure
