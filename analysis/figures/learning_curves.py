"""The paper's Figures 3, 4 and 5 from a sweep's data frames, as matplotlib figures.

``learning_curves`` is Figures 3 and 4 (one per agent): return and cost over training, and magnified over
deployment. ``curricula`` is Figure 5: the limits in force. Trials are averaged on a common grid of
environment steps (``curves.step_grid``), about 100 bins over a whole trial and 25 over its deployment.

Costs begin far above the limit and end near it. If they exceed ten limits, the cost axis is linear up to the
deployment limit and logarithmic above, which its label mentions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recrl.analysis.data.cost_names import cost_suffix
from recrl.analysis.data.labels import occurring
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import panels, styles
from recrl.analysis.figures.styles import TEXT_WIDTH, MethodStyle
from recrl.analysis.statistics.curves import MEAN, CurveAverage, ShownSteps, mean_curve
from recrl.analysis.statistics.verdicts import SOLVED_GAP
from recrl.environments.cmdp import Floats

DEPLOYMENT_BINS = 25
ROW_HEIGHT = 1.42
LEAST_SHOWN = 0.2  # of a limit, above and below it
LEAST_SHOWN_RETURN = 2.0 * SOLVED_GAP  # above and below J*(d_d)
LINE_BELOW_LINE = 0.07  # of a panel's height, between the marks of two curricula's infinite limits


def learning_curves(sweep: Sweep, agent: str, *, averaging: CurveAverage = MEAN) -> Figure:
    """Draw the paper's Figures 3 and 4: one row per task, return and cost over training and deployment.

    Args:
        sweep: with at least one update of this agent.
        agent: its label.
        averaging: kind of lines and bands; by default means and standard errors as in the paper.
    """
    trials = sweep.trials[sweep.trials["agent"] == agent]
    updates = sweep.updates[sweep.updates["agent"] == agent]
    tasks = occurring(updates["task"])
    num_costs = int(trials["num_costs"].max())
    look = styles.styles_of(sweep)
    columns = 2 + 2 * num_costs
    suffixes = [cost_suffix(sweep, i) for i in range(num_costs)]
    with styles.context():
        figure = Figure(
            figsize=(TEXT_WIDTH * max(1.0, columns / 4), ROW_HEIGHT * len(tasks) + 1.1), layout="constrained"
        )
        grid = figure.subplots(
            len(tasks), columns, squeeze=False, gridspec_kw={"width_ratios": [1.7, 1.0] * (columns // 2)}
        )
        for row, task in zip(grid, tasks, strict=True):
            _task_row(
                row,
                trials[trials["task"] == task],
                updates[updates["task"] == task],
                look,
                averaging=averaging,
            )
        for axes, title in zip(grid[0], _column_titles(suffixes), strict=True):
            axes.set_title(title)
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        present = [method for method in look if (updates["method"] == method).any()]
        optimum = bool(trials["optimal_return"].notna().any())
        seeds = updates.groupby(["task", "method"], observed=True)["seed"].nunique().tolist()
        title = f"{agent}: {averaging.describe(seeds)}"
        panels.legend(figure, look, present, optimum=optimum, title=title)
    return figure


def curricula(sweep: Sweep) -> Figure:
    """Draw the paper's Figure 5: the limits in force; one row per task and cost, one column per agent.

    Every run is a thin line, the mean over seeds a thick one; the agent's own cost, a mean over seeds too,
    is a faint line. Infinite limits are drawn along the upper edge with the sign of infinity, one line below
    the other. Those during the measurement of d_t are left out once it is known.

    Args:
        sweep: with at least one update.
    """
    updates = sweep.updates
    look = styles.styles_of(sweep)
    agents = occurring(updates["agent"])
    cells = [
        (task, i)
        for task in updates["task"].cat.categories
        for i in range(sweep.num_costs)
        if updates.loc[updates["task"] == task, f"limit_{i}"].notna().any()
    ]
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.6 * len(cells) + 1.2), layout="constrained")
        grid = figure.subplots(len(cells), len(agents), squeeze=False, sharey="row")
        for row, (task, i) in zip(grid, cells, strict=True):
            for axes, agent in zip(row, agents, strict=True):
                trials, rows = (panels.rows_of(frame, task, agent) for frame in (sweep.trials, updates))
                if len(rows):
                    _curriculum_panel(axes, trials, rows, look, i)
                    axes.set_title(panels.panel_title(trials, rows), loc="left", pad=3.0)
                else:
                    axes.set_title(f"{task}: nothing run yet", loc="left", pad=3.0)
                    axes.set_xticks([])
            row[0].set_ylim(bottom=0.0)
            limits = sweep.trials.loc[sweep.trials["task"] == task, f"deploy_limit_{i}"]
            _shade(list(row), float(limits.iloc[0]))
            suffix = cost_suffix(sweep, i, task)
            row[0].set_ylabel(f"limit of cost{suffix}" if suffix else "cost limit")
        for axes, agent in zip(grid[0], agents, strict=True):
            axes.set_title(f"{agent}\n{axes.get_title(loc='left')}", loc="left", pad=3.0)
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        present = [method for method in look if (updates["method"] == method).any()]
        panels.legend(
            figure,
            look,
            present,
            optimum=False,
            title="cost limits in force: every run thin, their mean thick\nthe agent's own cost: faint",
        )
    return figure


def _task_row(
    row: Sequence[Axes],
    trials: pd.DataFrame,
    updates: pd.DataFrame,
    look: dict[str, MethodStyle],
    *,
    averaging: CurveAverage,
) -> None:
    """Draw one task's panels: return, return in deployment, then the same for each cost."""
    quantities = ["episode_return", *(f"cost_{i}" for i in range((len(row) - 2) // 2))]
    for position, quantity in enumerate(quantities):
        whole, magnified = row[2 * position : 2 * position + 2]
        if not updates[quantity].notna().any():  # this task has fewer costs than another
            whole.set_axis_off()
            magnified.set_axis_off()
            continue
        _pair(whole, magnified, trials, updates, quantity, look=look, averaging=averaging)
        if quantity == "episode_return":
            panels.widen(magnified, float(trials["optimal_return"].iloc[0]), LEAST_SHOWN_RETURN)
        else:
            limit = float(trials[f"deploy_limit_{position - 1}"].iloc[0])
            panels.cost_axis(whole, limit, float(np.nanmax(updates[quantity].to_numpy(np.float64))))
            panels.widen(magnified, limit, LEAST_SHOWN * limit or LEAST_SHOWN)
            _shade([whole, magnified], limit)
    row[0].set_ylabel(panels.panel_title(trials, updates, separator="\n"))


def _pair(
    whole: Axes,
    magnified: Axes,
    trials: pd.DataFrame,
    updates: pd.DataFrame,
    quantity: str,
    *,
    look: dict[str, MethodStyle],
    averaging: CurveAverage,
) -> None:
    """Draw one quantity over all of training, and magnified in the deployment phase."""
    shown_steps = ShownSteps.of(trials)
    boundary, total = shown_steps.boundary, shown_steps.total
    deployment_updates = max(2, round(shown_steps.updates * (total - boundary) / total))
    deployment_edges = np.linspace(boundary, total, min(DEPLOYMENT_BINS, deployment_updates) + 1)
    deployed = updates[updates["end_step"] > boundary]
    for axes, edges, rows in (
        (whole, shown_steps.grid(), updates),
        (magnified, deployment_edges, deployed),
    ):
        _curves(axes, rows, quantity, edges, look, averaging=averaging)
        panels.step_axis(axes, edges[0], edges[-1])
        panels.reference_lines(axes, trials, quantity)
        panels.phase_boundary(axes, boundary, total)
    if not len(deployed):
        text = "not yet" if boundary < total else "none"
        magnified.text(0.5, 0.65, text, transform=magnified.transAxes, ha="center", color="0.4")


def _shade(panels_of_cost: Sequence[Axes], limit: float) -> None:
    """Shade the region above the limit, without changing the axes."""
    for axes in panels_of_cost:
        low, high = axes.get_ylim()
        panels.shade_above_limit(axes, limit)
        axes.set_ylim(low, max(high, limit * 1.05))


def _curves(
    axes: Axes,
    updates: pd.DataFrame,
    quantity: str,
    edges: Floats,
    look: dict[str, MethodStyle],
    *,
    averaging: CurveAverage,
) -> None:
    """Draw every method's line with its band; markers are staggered so that equal lines remain visible."""
    for position, (method, style) in enumerate(look.items()):
        chosen = updates[updates["method"] == method]
        if not len(chosen):
            continue
        curve = averaging.curve(chosen, quantity, edges)
        panels.draw_curve(axes, curve, style, place=(position, len(look)))
        panels.draw_band(axes, curve, style)


def _curriculum_panel(
    axes: Axes, trials: pd.DataFrame, updates: pd.DataFrame, look: dict[str, MethodStyle], i: int
) -> None:
    shown_steps = ShownSteps.of(trials)
    edges = shown_steps.grid()
    infinite = 0
    for position, (method, style) in enumerate(look.items()):
        chosen = updates[updates["method"] == method]
        for _, run in chosen.groupby("seed"):
            limits = run[f"limit_{i}"].where(np.isfinite(run[f"limit_{i}"]))
            axes.plot(
                run["end_step"],
                limits,
                color=style.colour,
                linewidth=0.4,
                alpha=0.55,
                drawstyle="steps-pre",
                zorder=2.0,
            )
        if not len(chosen):
            continue
        cost = mean_curve(chosen, f"cost_{i}", edges)
        axes.plot(cost.steps, cost.centre, color=style.colour, linewidth=1.0, alpha=0.35, zorder=1.8)
        curve = mean_curve(chosen, f"limit_{i}", edges)
        panels.draw_curve(axes, curve, style, place=(position, len(look)), wider=0.3)
        last = _end_of_infinite_limits(chosen, trials, i)
        if np.isfinite(last):
            _mark_infinite_limits(axes, last, style, number=infinite)
            infinite += 1
    panels.step_axis(axes, 0.0, shown_steps.total)
    panels.reference_lines(axes, trials, f"cost_{i}")
    panels.phase_boundary(axes, shown_steps.boundary, shown_steps.total)


def _end_of_infinite_limits(updates: pd.DataFrame, trials: pd.DataFrame, i: int) -> float:
    """Return the last step of a method's infinite limits, NaN if it has none but while d_t is measured.

    A trial with a finite ``start_limit_i`` has measured its d_t, or was given it. Then the infinite limits at
    its beginning are those of the measurement.
    """
    starts = trials[f"start_limit_{i}"]
    start: dict[tuple[Any, ...], float] = dict(
        zip(zip(trials["method"], trials["seed"], strict=True), starts, strict=True)
    )
    ends = [math.nan]
    for key, run in updates.groupby(["method", "seed"], observed=True):
        infinite = np.isinf(run[f"limit_{i}"].to_numpy(np.float64))
        if np.isfinite(start[tuple(key)]):
            infinite &= np.maximum.accumulate(~infinite)
        ends += run["end_step"].to_numpy(np.float64)[infinite].tolist()
    return float(np.nanmax(ends)) if len(ends) > 1 else math.nan


def _mark_infinite_limits(axes: Axes, last: float, style: MethodStyle, *, number: int) -> None:
    """Draw infinite limits until the step ``last``; ``number`` others are already drawn."""
    edge = axes.get_xaxis_transform()
    height = 1.0 - LINE_BELOW_LINE * number
    axes.plot([0.0, last], [height, height], **style.line, transform=edge, clip_on=False)
    axes.text(last, height, " ∞", color=style.colour, va="center", fontsize=9.0, transform=edge)


def _column_titles(suffixes: Sequence[str]) -> list[str]:
    titles = ["return", "return in deployment"]
    for suffix in suffixes:
        name = f"episode cost{suffix}"
        titles += [name, f"{name.removeprefix('episode ')} in deployment"]
    return titles
