"""The paper's figures, from a sweep's frames: functions that return a matplotlib Figure.

``learning_curves`` is Figures 3 and 4 (one a student): return and cost over training, and magnified over
deployment. ``curricula`` is Figure 5: the limits in force. Trials are averaged on a common grid of
environment steps (``metrics.step_grid``), about 100 bins over a whole trial and 25 over its deployment.

Costs begin far above the limit and end near it. Where they exceed ten limits, the cost axis is linear up to
the deployment limit and logarithmic above it, so that the limit can be read; the axis says so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from recrl.analysis import styles
from recrl.analysis.frames import Sweep
from recrl.analysis.metrics import learning_curve, step_grid
from recrl.analysis.styles import LIMIT_COLOUR, OPTIMUM_COLOUR, TEXT_WIDTH, MethodStyle

BINS = 100
DEPLOYMENT_BINS = 25
ROW_HEIGHT = 1.42
MARKERS_A_LINE = 6
LOG_AXIS_FROM = 10.0  # times the limit


def learning_curves(sweep: Sweep, agent: str) -> Figure:
    """The paper's Figures 3 and 4: a row a task, return and cost over training and over deployment.

    Args:
        sweep: with at least one update of this student.
        agent: its label.

    Returns:
        Lines are means over seeds, bands one standard error.
    """
    trials = sweep.trials[sweep.trials["agent"] == agent]
    updates = sweep.updates[sweep.updates["agent"] == agent]
    tasks = [task for task in updates["task"].cat.categories if (updates["task"] == task).any()]
    num_costs = int(trials["num_costs"].max())
    look = styles.method_styles(list(sweep.trials["method"].cat.categories))
    columns = 2 + 2 * num_costs
    with styles.context():
        figure = Figure(
            figsize=(TEXT_WIDTH * max(1.0, columns / 4), ROW_HEIGHT * len(tasks) + 0.8), layout="constrained"
        )
        grid = figure.subplots(
            len(tasks), columns, squeeze=False, gridspec_kw={"width_ratios": [1.7, 1.0] * (columns // 2)}
        )
        for row, task in zip(grid, tasks, strict=True):
            _task_row(row, trials[trials["task"] == task], updates[updates["task"] == task], look)
        for axes, title in zip(grid[0], _column_titles(num_costs), strict=True):
            axes.set_title(title)
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        present = [method for method in look if (updates["method"] == method).any()]
        optimum = bool(trials["optimal_return"].notna().any())
        _legend(figure, look, present, optimum=optimum, title=f"{agent}: mean ± standard error over seeds")
    return figure


def curricula(sweep: Sweep) -> Figure:
    """The paper's Figure 5: the cost limits in force; a row a task and cost, a column a student.

    Every run is a thin line, the mean over seeds a thick one. Infinite limits, which no axis reaches, are
    drawn along the upper edge and marked with the sign of infinity.

    Args:
        sweep: with at least one update.
    """
    updates = sweep.updates
    look = styles.method_styles(list(sweep.trials["method"].cat.categories))
    agents = [agent for agent in updates["agent"].cat.categories if (updates["agent"] == agent).any()]
    panels = [
        (task, i)
        for task in updates["task"].cat.categories
        for i in range(sweep.num_costs)
        if updates.loc[updates["task"] == task, f"limit_{i}"].notna().any()
    ]
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.6 * len(panels) + 0.75), layout="constrained")
        grid = figure.subplots(len(panels), len(agents), squeeze=False, sharey="row")
        for row, (task, i) in zip(grid, panels, strict=True):
            for axes, agent in zip(row, agents, strict=True):
                trials = _of(sweep.trials, task, agent)
                if len(trials):
                    _curriculum_panel(axes, trials, _of(updates, task, agent), look, i)
                    axes.set_title(_panel_title(trials, _of(updates, task, agent)), loc="left", pad=3.0)
            row[0].set_ylabel("cost limit" if sweep.num_costs == 1 else f"limit of cost {i + 1}")
        for axes, agent in zip(grid[0], agents, strict=True):
            axes.set_title(f"{agent}\n{axes.get_title(loc='left')}", loc="left", pad=3.0)
        for axes in grid[-1]:
            axes.set_xlabel("environment steps")
        present = [method for method in look if (updates["method"] == method).any()]
        _legend(
            figure,
            look,
            present,
            optimum=False,
            title="cost limits in force: every run thin, their mean thick",
        )
    return figure


def _task_row(
    row: Sequence[Axes], trials: pd.DataFrame, updates: pd.DataFrame, look: dict[str, MethodStyle]
) -> None:
    """One task's panels: return, return in deployment, then the same for each cost."""
    boundary, total = int(trials["boundary_step"].min()), int(trials["total_steps"].max())
    count = int(trials["total_steps"].max() // trials["steps_per_update"].min())
    whole = step_grid(boundary, total, updates=count, bins=BINS)
    deployment_updates = max(2, round(count * (total - boundary) / total))
    magnified = np.linspace(boundary, total, min(DEPLOYMENT_BINS, deployment_updates) + 1)
    quantities = ["episode_return", *(f"cost_{i}" for i in range((len(row) - 2) // 2))]
    deployed = updates[updates["end_step"] > boundary]
    for position, quantity in enumerate(quantities):
        if not updates[quantity].notna().any():  # this task has fewer costs than another one
            row[2 * position].set_axis_off()
            row[2 * position + 1].set_axis_off()
            continue
        for axes, edges, rows in (
            (row[2 * position], whole, updates),
            (row[2 * position + 1], magnified, deployed),
        ):
            _curves(axes, rows, quantity, edges, look)
            _step_axis(axes, edges[0], edges[-1])
            _reference_lines(axes, trials, quantity)
        _boundary(row[2 * position], boundary, total)
        _boundary(row[2 * position + 1], boundary, total)
        if not len(deployed):
            row[2 * position + 1].text(
                0.5, 0.5, "not yet", transform=row[2 * position + 1].transAxes, ha="center", color="0.4"
            )
        if quantity != "episode_return":
            limit = float(trials[f"deploy_limit_{position - 1}"].iloc[0])
            largest = float(np.nanmax(updates[quantity].to_numpy(np.float64)))
            _cost_axis(row[2 * position], limit, largest)
    row[0].set_ylabel(_panel_title(trials, updates, separator="\n"))


def _curves(
    axes: Axes, updates: pd.DataFrame, quantity: str, edges: np.ndarray, look: dict[str, MethodStyle]
) -> None:
    """Every method's mean with its band; markers are staggered so that equal lines can be told apart."""
    for position, (method, style) in enumerate(look.items()):
        chosen = updates[updates["method"] == method]
        if not len(chosen):
            continue
        curve = learning_curve(chosen, quantity, edges)
        drawn = np.isfinite(curve.mean)
        steps, mean, error = curve.steps[drawn], curve.mean[drawn], curve.standard_error[drawn]
        gap = max(1, len(steps) // MARKERS_A_LINE)
        axes.plot(
            steps,
            mean,
            color=style.colour,
            linestyle=style.linestyle,
            linewidth=style.width,
            marker=style.marker,
            markevery=(position * gap // len(look), gap),
            markeredgewidth=0.0,
            zorder=3.0 + 0.01 * position,
        )
        axes.fill_between(
            steps, mean - error, mean + error, color=style.colour, alpha=0.18, linewidth=0.0, zorder=2.0
        )


def _curriculum_panel(
    axes: Axes, trials: pd.DataFrame, updates: pd.DataFrame, look: dict[str, MethodStyle], i: int
) -> None:
    boundary, total = int(trials["boundary_step"].min()), int(trials["total_steps"].max())
    count = int(total // trials["steps_per_update"].min())
    edges = step_grid(boundary, total, updates=count, bins=BINS)
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
        curve = learning_curve(chosen, f"limit_{i}", edges)
        gap = max(1, len(edges) // MARKERS_A_LINE)
        axes.plot(
            curve.steps,
            curve.mean,
            color=style.colour,
            linestyle=style.linestyle,
            linewidth=style.width + 0.3,
            marker=style.marker,
            markevery=(position * gap // len(look), gap),
            markeredgewidth=0.0,
            zorder=3.0 + 0.01 * position,
        )
        infinite = chosen.loc[np.isinf(chosen[f"limit_{i}"]), "end_step"]
        if len(infinite):
            edge, last = axes.get_xaxis_transform(), float(infinite.max())
            axes.plot(
                [0.0, last],
                [1.0, 1.0],
                color=style.colour,
                linestyle=style.linestyle,
                linewidth=style.width + 0.3,
                transform=edge,
                clip_on=False,
            )
            axes.text(last, 1.0, " ∞", color=style.colour, va="center", fontsize=9.0, transform=edge)
    _step_axis(axes, 0.0, total)
    _reference_lines(axes, trials, f"cost_{i}")
    _boundary(axes, boundary, total)
    axes.set_ylim(bottom=0.0)


def _reference_lines(axes: Axes, trials: pd.DataFrame, quantity: str) -> None:
    """The deployment limit on cost panels, the optimum J*(d_d) on return panels."""
    if quantity == "episode_return":
        for optimum in sorted(set(trials["optimal_return"].dropna())):
            axes.axhline(optimum, color=OPTIMUM_COLOUR, linewidth=0.7, zorder=1.0)
        return
    for limit in sorted(set(trials[f"deploy_limit_{quantity.removeprefix('cost_')}"].dropna())):
        axes.axhline(limit, color=LIMIT_COLOUR, linewidth=1.1, linestyle=(0.0, (4.0, 2.0)), zorder=4.0)


def _boundary(axes: Axes, boundary: int, total: int) -> None:
    if 0 < boundary < total:
        axes.axvline(boundary, color="black", linewidth=0.8, linestyle=(0.0, (4.0, 2.0)), zorder=1.5)


def _step_axis(axes: Axes, first: float, last: float) -> None:
    """Ticks like 0.5M: short enough for small panels."""
    axes.set_xlim(first, last)
    axes.xaxis.set_major_locator(MaxNLocator(4 if first == 0.0 else 2, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_steps(value)))


def _cost_axis(axes: Axes, limit: float, largest: float) -> None:
    """Linear to the limit and logarithmic above, if the costs exceed ten limits; never below 0."""
    axes.set_ylim(bottom=0.0)
    if largest <= LOG_AXIS_FROM * limit:
        return
    linear_to = limit if limit > 0.0 else 1.0
    axes.set_yscale("symlog", linthresh=linear_to, linscale=0.8)
    axes.set_ylim(0.0, 1.25 * largest)
    axes.yaxis.set_major_locator(FixedLocator([0.0, linear_to, *_log_ticks(2.0 * linear_to, largest)]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel("log above $d_d$", fontsize=6.0, labelpad=1.0)


def _log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten within [low, high]; with 2 and 5 times each, if there are fewer than two.

    >>> _log_ticks(2.0, 120.0), _log_ticks(10.0, 90.0)
    ([10.0, 100.0], [10.0, 20.0, 50.0])
    """
    decades = [10.0**power for power in range(-6, 13)]
    powers = [value for value in decades if low <= value <= high]
    between = [scale * value for value in decades for scale in (1.0, 2.0, 5.0)]
    return powers if len(powers) > 1 else [value for value in between if low <= value <= high]


def short_steps(steps: float) -> str:
    """A number of steps in at most five characters.

    >>> [short_steps(value) for value in (0, 500, 12_000, 960_000, 1_260_000, 1e7)]
    ['0', '500', '12k', '960k', '1.26M', '10M']
    """
    if abs(steps) >= 1e6:
        return f"{steps / 1e6:.4g}M"
    return f"{steps / 1e3:.4g}k" if abs(steps) >= 1e3 else f"{steps:g}"


def _panel_title(trials: pd.DataFrame, updates: pd.DataFrame, *, separator: str = ": ") -> str:
    """Task, number of seeds (a range, if not every method has as many at the end) and steps."""
    seeds = updates.groupby("method", observed=True)["seed"]
    ended = updates[updates["end_step"] >= trials["total_steps"].max()]
    finished = ended.groupby("method", observed=True)["seed"].nunique()
    high = int(seeds.nunique().max())
    low = min(int(finished.get(method, 0)) for method in seeds.nunique().index)
    count = f"{high}" if low == high else f"{low}–{high}"
    task, total = trials["task"].iloc[0], short_steps(float(trials["total_steps"].max()))
    return f"{task}{separator}{count} seed{'s' if high > 1 else ''}, {total} steps"


def _column_titles(num_costs: int) -> list[str]:
    titles = ["return", "return in deployment"]
    for i in range(num_costs):
        name = "episode cost" if num_costs == 1 else f"episode cost {i + 1}"
        titles += [name, f"{name.removeprefix('episode ')} in deployment"]
    return titles


def _legend(
    figure: Figure, look: dict[str, MethodStyle], methods: Sequence[str], *, optimum: bool, title: str
) -> None:
    """One legend above all panels: a line for the methods, in their order, and one for the references."""
    lines = [
        Line2D(
            [],
            [],
            color=look[method].colour,
            linestyle=look[method].linestyle,
            linewidth=look[method].width,
            marker=look[method].marker,
            markeredgewidth=0.0,
            label=method,
        )
        for method in methods
    ]
    dashed = (0.0, (4.0, 2.0))
    references = [
        Line2D([], [], color=LIMIT_COLOUR, linewidth=1.1, linestyle=dashed, label="limit $d_d$"),
        Line2D([], [], color="black", linewidth=0.8, linestyle=dashed, label="deployment begins"),
    ]
    if optimum:
        references.append(Line2D([], [], color=OPTIMUM_COLOUR, linewidth=0.7, label="optimum $J^*(d_d)$"))
    columns = max(len(lines), len(references))
    blank = Line2D([], [], linestyle="none", label=" ")
    padded = [row + [blank] * (columns - len(row)) for row in (lines, references)]
    figure.legend(
        handles=[handle for column in zip(*padded, strict=True) for handle in column],  # filled by columns
        loc="outside upper center",
        ncols=columns,
        handlelength=2.6,
        columnspacing=1.4,
        title=title,
    )


def _of(frame: pd.DataFrame, task: str, agent: str) -> pd.DataFrame:
    return frame[(frame["task"] == task) & (frame["agent"] == agent)]
