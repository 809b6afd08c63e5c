"""Return against cost: where the final policies of all runs lie under the exact frontier J*(d).

No policy lies above the frontier but by the chance of its evaluation's episodes, and no good one lies to the
right of the limit. The points are the frozen policies, sampled (``Measure.STOCHASTIC``): the frontier is
about the expectation of one policy, not about the deployment phase, which averages over many.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from recrl.analysis.data.labels import occurring
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import styles
from recrl.analysis.figures.styles import LIMIT_COLOUR, OPTIMUM_COLOUR, TEXT_WIDTH, MethodStyle
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.metrics import Measure
from recrl.environments.cmdp import CostLimits, Floats
from recrl.environments.registry import optimal_return

FAR_COST = 10.0  # times the limit: points beyond are drawn at the right edge


def return_against_cost(sweep: Sweep) -> Figure | None:
    """A row a task with one cost and a known optimum, a column a student; a point a run.

    Args:
        sweep: its complete trials are drawn.

    Returns:
        The figure, or None if no complete trial is of such a task.
    """
    rows = metrics.outcomes(sweep)
    rows = rows[rows["measure"] == Measure.STOCHASTIC.value]
    single = sweep.trials[(sweep.trials["num_costs"] == 1) & sweep.trials["optimal_return"].notna()]
    rows = rows[rows["task"].isin(set(single["task"]))]
    if not len(rows):
        return None
    look = styles.method_styles(list(sweep.trials["method"].cat.categories))
    tasks, agents = occurring(rows["task"]), occurring(rows["agent"])
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 2.0 * len(tasks) + 0.6), layout="constrained")
        grid = figure.subplots(len(tasks), len(agents), squeeze=False, sharex="row", sharey="row")
        for row, task in zip(grid, tasks, strict=True):
            trials, chosen = single[single["task"] == task], rows[rows["task"] == task]
            costs, returns = _frontier(sweep, trials, far=_right_edge(chosen))
            for axes, agent in zip(row, agents, strict=True):
                axes.plot(costs, returns, color=OPTIMUM_COLOUR, linewidth=0.9, zorder=1.0)
                _points(axes, chosen[chosen["agent"] == agent], look, far=costs[-1])
                for limit in sorted(set(chosen["deploy_limit_0"])):
                    axes.axvline(limit, color=LIMIT_COLOUR, linewidth=1.1, linestyle=(0.0, (4.0, 2.0)))
                axes.set_title(f"{task}, {agent}", loc="left", pad=3.0)
            row[0].set_ylabel("return")
        for axes in grid[-1]:
            axes.set_xlabel("episode cost")
        present = [method for method in look if (rows["method"] == method).any()]
        _legend(figure, look, present)
    return figure


def concave_frontier(optimum: Callable[[float], float], far: float, *, tolerance: float) -> Floats:
    """Sample a concave function of the limit finely where it bends and nowhere else.

    Args:
        optimum: d -> J*(d), concave and non-decreasing.
        far: the largest d, above 0.
        tolerance: how far the polyline may lie below the function at the middle of a piece.

    Returns:
        Points (d, J*(d)) in ascending d, [p, 2].
    """

    def refined(left: tuple[float, float], right: tuple[float, float]) -> list[tuple[float, float]]:
        middle = (left[0] + right[0]) / 2.0
        value = optimum(middle)
        straight = value - (left[1] + right[1]) / 2.0 <= tolerance
        if straight or right[0] - left[0] < far / 64.0:
            return [left, (middle, value)]
        return refined(left, (middle, value)) + refined((middle, value), right)

    ends = [(0.0, optimum(0.0)), (far, optimum(far))]
    return np.array([*refined(ends[0], ends[1]), ends[1]])


def _frontier(sweep: Sweep, trials: pd.DataFrame, *, far: float) -> tuple[Floats, Floats]:
    """J*(d) of a task for limits 0 ... ``far``, with the deployment limits among them."""
    first = trials.iloc[0]
    name, options = str(first["task_name"]), sweep.task_options[str(first["task"])]

    def optimum(limit: float) -> float:
        value = optimal_return(name, options, CostLimits((limit,)))
        assert value is not None  # the task knew it for d_d
        return value

    scale = abs(optimum(far) - optimum(0.0)) + 1e-9
    points = concave_frontier(optimum, far, tolerance=1e-3 * scale)
    known = [(limit, optimum(limit)) for limit in sorted(set(trials["deploy_limit_0"]))]
    points = np.unique(np.concatenate([points, np.array(known)]), axis=0)
    return points[:, 0], points[:, 1]


def _right_edge(rows: pd.DataFrame) -> float:
    """A cost that shows the limit and nearly all points."""
    limit = float(rows["deploy_limit_0"].max())
    scale = limit if limit > 0.0 else 1.0
    return min(max(2.0 * scale, 1.15 * float(rows["cost_0"].max())), FAR_COST * scale)


def _points(axes: Axes, rows: pd.DataFrame, look: dict[str, MethodStyle], *, far: float) -> None:
    """A small point a run and an open one for the mean; what lies too far right sits on the edge.

    The open marks shrink from method to method, so that equal means show as marks within each other.
    """
    for position, (method, style) in enumerate(look.items()):
        chosen = rows[rows["method"] == method]
        if not len(chosen):
            continue
        costs = np.minimum(chosen["cost_0"].to_numpy(np.float64), far)
        returns = chosen["episode_return"].to_numpy(np.float64)
        axes.scatter(
            costs,
            returns,
            s=9.0,
            c=style.colour,
            marker=style.marker,
            linewidths=0.0,
            clip_on=False,
            zorder=3.0,
        )
        axes.scatter(
            [min(far, float(chosen["cost_0"].mean()))],
            [returns.mean()],
            s=(11.0 - 1.4 * min(position, 5)) ** 2,
            marker=style.marker,
            facecolors="none",
            edgecolors=style.colour,
            linewidths=1.1,
            clip_on=False,
            zorder=4.0,
        )
    axes.set_xlim(-0.05 * far, far)


def _legend(figure: Figure, look: dict[str, MethodStyle], methods: list[str]) -> None:
    handles = [
        Line2D([], [], color=look[method].colour, marker=look[method].marker, linestyle="none", label=method)
        for method in methods
    ]
    handles += [
        Line2D([], [], color=LIMIT_COLOUR, linewidth=1.1, linestyle=(0.0, (4.0, 2.0)), label="limit $d_d$"),
        Line2D([], [], color=OPTIMUM_COLOUR, linewidth=0.9, label="frontier $J^*(d)$"),
    ]
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=len(handles),
        columnspacing=1.2,
        handletextpad=0.5,
        title="frozen final policies, sampled: a filled mark a run, an open one their mean",
    )
