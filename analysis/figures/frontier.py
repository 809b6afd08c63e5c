"""Return against cost of the final policies, with the limit and the best return J*(d).

The region above the limit is shaded. A policy in it may be feasible within the tolerance. One outside may
exceed the limit of another cost. So only the fill of a mark says what is feasible. No policy lies above the
frontier, except by the sampling error of episodes.

The points are the stochastic final policies (``Measure.STOCHASTIC``), exact if the task is finite. The
deployment phase, which averages many policies, is not drawn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from recrl.analysis.data.cost_names import cost_suffix
from recrl.analysis.data.labels import occurring
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import panels, styles
from recrl.analysis.figures.styles import LIMIT_COLOUR, OPTIMUM_COLOUR, TEXT_WIDTH, MethodStyle
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.metrics import Measure
from recrl.environments.cmdp import CostLimits, Floats
from recrl.environments.registry import optimal_return

COST, LIMIT = "shown_cost", "shown_limit"  # columns of the cost in a row of panels
FILL = 0.4  # opacity of the marks of feasible policies; the others are white inside
FAR_COST = 10.0  # times the limit: points beyond are drawn at the right edge


def return_against_cost(sweep: Sweep) -> Figure | None:
    """Draw one row per task and cost, one column per agent, one point per run.

    The limit is a line, and the region beyond it is shaded. The frontier J*(d) is drawn if a task has one
    cost and a known optimum.

    Args:
        sweep: its complete trials are drawn.

    Returns:
        The figure, or None if no trial is complete.
    """
    rows = metrics.outcomes(sweep)
    rows = rows[rows["measure"] == Measure.STOCHASTIC.value]
    if not len(rows):
        return None
    look = styles.styles_of(sweep)
    agents = occurring(rows["agent"])
    cells = _cells(sweep, rows)
    clipped = known = False
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 2.0 * len(cells) + 1.05), layout="constrained")
        grid = figure.subplots(len(cells), len(agents), squeeze=False, sharex="row", sharey="row")
        for line, (task, i) in zip(grid, cells, strict=True):
            chosen = rows[rows["task"] == task].rename(
                columns={f"cost_{i}": COST, f"deploy_limit_{i}": LIMIT}
            )
            trials = sweep.trials[sweep.trials["task"] == task]
            far = _right_edge(chosen)
            clipped = clipped or bool((chosen[COST] > far).any())
            costs, returns = _frontier(sweep, trials, far=far)
            known = known or bool(costs.size)
            for axes, agent in zip(line, agents, strict=True):
                axes.plot(costs, returns, color=OPTIMUM_COLOUR, linewidth=0.9, zorder=1.0)
                of_agent = chosen[chosen["agent"] == agent]
                _points(axes, of_agent, look, far=far)
                if not len(of_agent):
                    plain = {"facecolor": "white", "edgecolor": "none"}
                    axes.text(
                        0.5, 0.5, "no complete trial", ha="center", transform=axes.transAxes, bbox=plain
                    )
                for limit in sorted(set(chosen[LIMIT])):
                    axes.axvline(limit, color=LIMIT_COLOUR, linewidth=1.1, linestyle=panels.DASHED)
                    axes.axvspan(limit, far, **panels.ABOVE_LIMIT)
                axes.set_xlabel(f"episode cost{cost_suffix(sweep, i, task)}")
            line[0].set_ylabel(f"{task}\nreturn")
        for axes, agent in zip(grid[0], agents, strict=True):
            axes.set_title(agent, pad=4.0)
        present = [method for method in look if (rows["method"] == method).any()]
        _legend(figure, look, present, known=known, clipped=clipped)
    return figure


def _cells(sweep: Sweep, rows: pd.DataFrame) -> list[tuple[str, int]]:
    """Return the tasks with a complete trial, with each of their costs."""
    return [
        (task, i)
        for task in occurring(rows["task"])
        for i in range(sweep.num_costs)
        if rows.loc[rows["task"] == task, f"deploy_limit_{i}"].notna().any()
    ]


def concave_frontier(optimum: Callable[[float], float], far: float, *, tolerance: float) -> Floats:
    """Sample a concave function of the limit, finely only where it bends.

    Args:
        optimum: d -> J*(d), concave and non-decreasing; minus infinity where no policy keeps the limit.
        far: the largest d, above 0; a policy keeps it.
        tolerance: largest distance of the polyline below the function at the middle of a piece.

    Returns:
        Points (d, J*(d)) in ascending d, from the least d that a policy keeps, [p, 2].
    """

    def refined(left: tuple[float, float], right: tuple[float, float]) -> list[tuple[float, float]]:
        middle = (left[0] + right[0]) / 2.0
        value = optimum(middle)
        straight = value - (left[1] + right[1]) / 2.0 <= tolerance
        if straight or right[0] - left[0] < far / 64.0:
            return [left, (middle, value)]
        return refined(left, (middle, value)) + refined((middle, value), right)

    least = _least_feasible(optimum, far)
    ends = [(least, optimum(least)), (far, optimum(far))]
    return np.array([*refined(ends[0], ends[1]), ends[1]])


def _least_feasible(optimum: Callable[[float], float], far: float) -> float:
    """Return 0, or nearly the least limit that a policy keeps."""
    if np.isfinite(optimum(0.0)):
        return 0.0
    low, high = 0.0, far
    while high - low > 1e-3 * far:
        middle = (low + high) / 2.0
        low, high = (low, middle) if np.isfinite(optimum(middle)) else (middle, high)
    return high


def _frontier(sweep: Sweep, trials: pd.DataFrame, *, far: float) -> tuple[Floats, Floats]:
    """Return J*(d) of a task for limits 0 ... ``far``, deployment limits included; empty if unknown."""
    first = trials.iloc[0]
    if first["num_costs"] > 1 or not np.isfinite(first["optimal_return"]):
        return np.empty(0), np.empty(0)
    name, options = str(first["task_name"]), sweep.task_options[str(first["task"])]

    def optimum(limit: float) -> float:
        value = optimal_return(name, options, CostLimits((limit,)))
        assert value is not None  # it was known for d_d
        return value

    scale = abs(optimum(far) - optimum(_least_feasible(optimum, far))) + 1e-9
    points = concave_frontier(optimum, far, tolerance=1e-3 * scale)
    limits = sorted(set(trials["deploy_limit_0"]))
    known = [(limit, best) for limit in limits if np.isfinite(best := optimum(limit))]
    points = np.unique(np.concatenate([points, np.array(known)]), axis=0)
    return points[:, 0], points[:, 1]


def _right_edge(rows: pd.DataFrame) -> float:
    """Return the upper end of a cost axis that shows the limit and nearly all points."""
    limit = float(rows[LIMIT].max())
    scale = limit if limit > 0.0 else 1.0
    return min(max(2.0 * scale, 1.15 * float(rows[COST].max())), FAR_COST * scale)


def _points(axes: Axes, rows: pd.DataFrame, look: dict[str, MethodStyle], *, far: float) -> None:
    """Draw a mark per run, filled if feasible; runs too far to the right are at the edge.

    The marks get smaller from method to method, so that equal runs are visible as nested marks.
    """
    for position, (method, style) in enumerate(look.items()):
        chosen = rows[rows["method"] == method]
        axes.scatter(
            np.minimum(chosen[COST].to_numpy(np.float64), far),
            chosen["episode_return"].to_numpy(np.float64),
            s=_mark_size(position) ** 2,
            marker=style.marker,
            facecolors=[(style.colour, FILL) if feasible else "white" for feasible in chosen["feasible"]],
            edgecolors=style.colour,
            linewidths=1.1,
            clip_on=False,
            zorder=3.0,
        )
    axes.set_xlim(-0.05 * far, far)


def _mark_size(position: int) -> float:
    """Return the diameter of a method's marks, in points."""
    return 9.0 - 1.3 * min(position, 5)


def _legend(
    figure: Figure, look: dict[str, MethodStyle], methods: list[str], *, known: bool, clipped: bool
) -> None:
    """Draw the legends.

    Args:
        figure: the whole one.
        look: of all methods.
        methods: that are drawn.
        known: whether a best return is drawn.
        clipped: whether a mark is on the right edge because its cost is larger.
    """
    handles = [
        Line2D(
            [],
            [],
            color=look[method].colour,
            marker=look[method].marker,
            markerfacecolor="none",
            markersize=_mark_size(list(look).index(method)),
            linestyle="none",
            label=method,
        )
        for method in methods
    ]
    references: list[Line2D | Patch] = [
        Line2D([], [], color=LIMIT_COLOUR, linewidth=1.1, linestyle=panels.DASHED, label="limit $d_d$"),
        panels.above_limit_patch(),
    ]
    if known:
        best = Line2D([], [], color=OPTIMUM_COLOUR, linewidth=0.9, label="best return $J^*(d)$, where known")
        references.append(best)
    panels.legend_below(figure, references)
    title = "final policies, one mark per run: filled if feasible, hollow if not"
    if len(methods) > 1:
        title += "\nmarks differ in size only so that equal runs are visible"
    if clipped:
        title += "\nmarks on the right edge: the cost is beyond the axis"
    panels.legend_above(
        figure, handles, most=panels.METHODS_A_LINE, title=title, columnspacing=1.2, handletextpad=0.5
    )
