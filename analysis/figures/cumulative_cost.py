"""The cumulative cost of training against its bounds: Proposition 1 and measured costs on one axis.

One row per task, one column per method. Costs are summed over the policies of the training phase, one
expected episode each. ``recrl.analysis.statistics.cumulative_cost`` defines the lines. The cost axis is
logarithmic, because the proven bounds are far above the measured costs; each panel has the ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from recrl.analysis.data.labels import KEY, occurring
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import panels, styles
from recrl.analysis.figures.styles import IN_FORCE_COLOUR, TEXT_WIDTH, MethodStyle
from recrl.analysis.statistics.cumulative_cost import policies_of, training_runs
from recrl.analysis.statistics.metrics import with_finished_training
from recrl.environments.cmdp import Floats

# Colour, dashes and name of every sum except the measured one.
REFERENCES: dict[str, tuple[str, Literal["-"] | tuple[float, Sequence[float]], str]] = {
    "limit": (IN_FORCE_COLOUR, "-", "limits in force, the cost where infinite"),
    "discounted_bound": ("#5b3a8c", (0.0, (1.2, 1.2)), "Proposition 1, discounted cost"),
    "bound": ("black", (0.0, (6.0, 1.5, 1.2, 1.5)), "bound, undiscounted cost"),
    "ceiling": ("#8a8a8a", (0.0, (7.0, 3.0)), "trivial bound: every step at the largest cost"),
}


def cumulative_bounds(sweep: Sweep, agent: str, *, cost: int = 0) -> Figure | None:
    """Measured cost, limits and bounds, summed over the policies of the training phase.

    Args:
        sweep: the frames.
        agent: the agent's label.
        cost: i, index of the cost.

    Returns:
        The figure, with runs as thin lines and their mean as a thick one; or None if no trial of the agent
        has finished its training phase.
    """
    trials = with_finished_training(sweep)
    trials = trials[(trials["agent"] == agent) & trials[f"deploy_limit_{cost}"].notna()]
    if not len(trials):
        return None
    look = styles.styles_of(sweep)
    tasks = occurring(trials["task"])
    methods = [method for method in look if (trials["method"] == method).any()]
    runs = training_runs(sweep)
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.55 * len(tasks) + 1.0), layout="constrained")
        grid = figure.subplots(len(tasks), len(methods), squeeze=False, sharex="row", sharey="row")
        for row, task in zip(grid, tasks, strict=True):
            for axes, method in zip(row, methods, strict=True):
                chosen = trials[(trials["task"] == task) & (trials["method"] == method)]
                series = [
                    policies_of(sweep, trial, runs[tuple(trial[name] for name in KEY)], cost=cost)
                    for _, trial in chosen.iterrows()
                ]
                axes.set_title(method)
                if series:
                    _panel(axes, series, look[method])
            row[0].set_ylabel(f"{task}\ncumulative cost")
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        drawn = {str(line.get_label()) for axes in grid.flat for line in axes.get_lines()}
        _legend(figure, agent, drawn)
    return figure


def _panel(axes: Axes, series: list[pd.DataFrame], style: MethodStyle) -> None:
    """Draw one method's sums; ``series`` are of ``policy_costs``, one per run."""
    steps = series[0]["end_step"].to_numpy(np.float64)
    measured = _sums(series, "cost")
    axes.set_yscale("log")
    for run in measured:
        axes.plot(steps, run, color=style.colour, linewidth=0.4, alpha=0.55)
    axes.plot(steps, measured.mean(axis=0), color=style.colour, linewidth=1.5, zorder=4.0)
    for name, (colour, dashes, label) in REFERENCES.items():
        mean = _sums(series, name).mean(axis=0)
        if np.isfinite(mean).any():
            axes.plot(steps, mean, color=colour, linestyle=dashes, linewidth=0.9, label=label, zorder=3.0)
    bound, total = _sums(series, "bound").mean(axis=0)[-1], measured.mean(axis=0)[-1]
    if np.isfinite(bound) and total > 0.0:
        note = f"bound: {bound / total:.3g} times\nthe measured cost"
        axes.text(0.97, 0.04, note, transform=axes.transAxes, ha="right", va="bottom", fontsize=6.0)
    panels.step_axis(axes, 0.0, float(steps[-1]))


def _sums(series: list[pd.DataFrame], name: str) -> Floats:
    """Return running sums of every run, [n, policies]; an infinite limit counts as the cost."""
    rows = []
    for run in series:
        values = run[name].to_numpy(np.float64)
        if name == "limit":
            values = np.where(np.isfinite(values), values, run["cost"])
        rows.append(np.cumsum(values))
    return np.array(rows)


def _legend(figure: Figure, agent: str, drawn: set[str]) -> None:
    """Draw the legend of the drawn sums: only CPO has bounds, only known tasks a trivial one."""
    handles = [Line2D([], [], color="0.2", linewidth=1.5, label="measured cost, undiscounted")]
    handles += [
        Line2D([], [], color=colour, linestyle=dashes, linewidth=0.9, label=name)
        for colour, dashes, name in REFERENCES.values()
        if name in drawn
    ]
    title = f"{agent}: cost of training, one episode of each policy, summed\nevery run thin, the mean thick"
    panels.legend_above(figure, handles, most=panels.REFERENCES_A_LINE, title=title)
