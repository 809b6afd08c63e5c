"""Common parts of all panels over environment steps: axes, reference lines, titles, the legend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from recrl.analysis.figures.styles import LIMIT_COLOUR, OPTIMUM_COLOUR, MethodStyle
from recrl.analysis.statistics.curves import Curve

LOG_AXIS_FROM = 10.0  # times the limit
MARKERS_A_LINE = 6
METHODS_A_LINE, REFERENCES_A_LINE = 4, 2  # of a legend: a phone shows the left half of a figure
DASHED = (0.0, (4.0, 2.0))
ABOVE_LIMIT: dict[str, Any] = {"color": "#c0392b", "alpha": 0.08, "linewidth": 0.0, "zorder": 0.5}
Entry = TypeVar("Entry")
FAR_ABOVE = 1e6  # times the limit: the shaded region has no upper end


def draw_curve(
    axes: Axes, curve: Curve, style: MethodStyle, *, place: tuple[int, int], wider: float = 0.0
) -> None:
    """Draw a method's line so that coinciding methods remain visible.

    Markers are staggered from method to method, and dashed lines lie on top of solid ones.

    Args:
        axes: to draw on.
        curve: its data; bins without data are bridged.
        style: of the method.
        place: the method's position and the number of methods.
        wider: points added to the line's width.
    """
    drawn = np.isfinite(curve.centre)
    position, methods = place
    bins = max(1, int(drawn.sum()))
    gap = max(methods, bins // MARKERS_A_LINE)
    axes.plot(
        curve.steps[drawn],
        curve.centre[drawn],
        color=style.colour,
        linestyle=style.linestyle,
        linewidth=style.width + wider,
        marker=style.marker,
        markevery=(position * gap // methods % bins, gap),
        markeredgewidth=0.0,
        zorder=3.0 + 0.5 * bool(style.dashes) + 0.01 * position,
    )


def draw_band(axes: Axes, curve: Curve, style: MethodStyle) -> None:
    """Draw the band around the line."""
    drawn = np.isfinite(curve.centre)
    axes.fill_between(
        curve.steps[drawn],
        curve.low[drawn],
        curve.high[drawn],
        color=style.colour,
        alpha=0.18,
        linewidth=0.0,
        zorder=2,
    )


def reference_lines(axes: Axes, trials: pd.DataFrame, quantity: str) -> None:
    """Draw the deployment limit on cost panels, the optimum J*(d_d) on return panels."""
    if quantity == "episode_return":
        for optimum in sorted(set(trials["optimal_return"].dropna())):
            axes.axhline(optimum, color=OPTIMUM_COLOUR, linewidth=0.7, zorder=1.0)
        return
    for limit in sorted(set(trials[f"deploy_limit_{quantity.removeprefix('cost_')}"].dropna())):
        axes.axhline(limit, color=LIMIT_COLOUR, linewidth=1.1, linestyle=DASHED, zorder=4.0)


def shade_above_limit(axes: Axes, limit: float) -> None:
    """Shade the costs above a deployment limit."""
    if np.isfinite(limit):
        axes.axhspan(limit, FAR_ABOVE * max(limit, 1.0), **ABOVE_LIMIT)


def widen(axes: Axes, centre: float, least: float) -> None:
    """Make a y-axis cover at least ``centre`` ± ``least``, so that rounding errors do not fill a panel.

    Args:
        axes: to change.
        centre: for example a limit; nothing happens if it is not finite.
        least: half of the least height.
    """
    if np.isfinite(centre):
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, centre - least), max(high, centre + least))


def phase_boundary(axes: Axes, step: int, total: int) -> None:
    """Mark the beginning of deployment."""
    if 0 < step < total:
        axes.axvline(step, color="black", linewidth=0.8, linestyle=DASHED, zorder=1.5)


def step_axis(axes: Axes, first: float, last: float) -> None:
    """Set ticks like 0.5M, short enough for small panels."""
    if first < last:
        axes.set_xlim(first, last)
    axes.xaxis.set_major_locator(MaxNLocator(4 if first == 0.0 else 2, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_steps(value)))


def cost_axis(axes: Axes, limit: float, largest: float) -> str:
    """Make a cost axis linear to the limit and logarithmic above, if the costs exceed ten limits.

    Returns:
        The axis' label, which says so; empty for a linear axis.
    """
    if largest <= LOG_AXIS_FROM * limit:
        axes.set_ylim(bottom=-0.04 * largest)
        return ""
    linear_to = limit if limit > 0.0 else 1.0
    axes.set_yscale("symlog", linthresh=linear_to, linscale=0.8)
    axes.set_ylim(-0.15 * linear_to, 1.25 * largest)
    axes.yaxis.set_major_locator(FixedLocator([0.0, linear_to, *_log_ticks(2.0 * linear_to, largest)]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    label = "log above $d_d$" if limit > 0.0 else "log above 1"
    axes.set_ylabel(label, fontsize=6.0, labelpad=1.0)
    return label


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten within [low, high], with 2 and 5 times each if there are fewer than two.

    >>> _log_ticks(2.0, 120.0), _log_ticks(10.0, 90.0)
    ([10.0, 100.0], [10.0, 20.0, 50.0])
    """
    decades = [10.0**power for power in range(-6, 13)]
    powers = [value for value in decades if low <= value <= high]
    between = [scale * value for value in decades for scale in (1.0, 2.0, 5.0)]
    return powers if len(powers) > 1 else [value for value in between if low <= value <= high]


def short_steps(steps: float) -> str:
    """Format a number of steps in at most five characters.

    >>> [short_steps(value) for value in (0, 500, 12_000, 960_000, 1_260_000, 1e7)]
    ['0', '500', '12k', '960k', '1.26M', '10M']
    """
    if abs(steps) >= 1e6:
        return f"{steps / 1e6:.4g}M"
    return f"{steps / 1e3:.4g}k" if abs(steps) >= 1e3 else f"{steps:g}"


def rows_of(frame: pd.DataFrame, task: str, agent: str) -> pd.DataFrame:
    """Return the rows of one task and agent.

    Args:
        frame: one of a sweep's data frames.
        task: its label.
        agent: the agent's label.
    """
    return frame[(frame["task"] == task) & (frame["agent"] == agent)]


def panel_title(trials: pd.DataFrame, updates: pd.DataFrame, *, separator: str = ": ") -> str:
    """Return task, number of seeds (a range if methods differ) and steps."""
    seeds = updates.groupby("method", observed=True)["seed"]
    ended = updates[updates["end_step"] >= trials["total_steps"].max()]
    finished = ended.groupby("method", observed=True)["seed"].nunique()
    high = int(seeds.nunique().max())
    low = min(int(finished.get(method, 0)) for method in seeds.nunique().index)
    count = f"{high}" if low == high else f"{low}–{high}"
    task, total = trials["task"].iloc[0], short_steps(float(trials["total_steps"].max()))
    return f"{task}{separator}{count} seed{'s' if high > 1 else ''}, {total} steps"


def above_limit_patch() -> Patch:
    """Return the legend's entry for the region above the deployment limit."""
    return Patch(facecolor=ABOVE_LIMIT["color"], alpha=0.2, linewidth=0.0, label="above $d_d$")


def legend(
    figure: Figure,
    look: dict[str, MethodStyle],
    methods: Sequence[str],
    *,
    optimum: bool,
    title: str,
) -> None:
    """Draw the legend: methods above all panels, in order, and reference lines below."""
    lines = [
        Line2D([], [], **look[method].line, marker=look[method].marker, markeredgewidth=0.0, label=method)
        for method in methods
    ]
    references: list[Line2D | Patch] = [
        Line2D([], [], color=LIMIT_COLOUR, linewidth=1.1, linestyle=DASHED, label="limit $d_d$"),
        above_limit_patch(),
        Line2D([], [], color="black", linewidth=0.8, linestyle=DASHED, label="deployment begins"),
    ]
    if optimum:
        references.append(Line2D([], [], color=OPTIMUM_COLOUR, linewidth=0.7, label="optimum $J^*(d_d)$"))
    legend_above(figure, lines, most=METHODS_A_LINE, title=title, handlelength=3.2, columnspacing=1.6)
    legend_below(figure, references)


def legend_above(
    figure: Figure, handles: Sequence[Line2D | Patch], *, most: int, title: str, **settings: Any
) -> None:
    """Draw a legend at the upper left of a figure, to be read row by row.

    Args:
        figure: with constrained layout.
        handles: the entries, in order.
        most: entries in a row; rows are filled evenly.
        title: above the entries.
        settings: of ``Figure.legend``.
    """
    columns = even_columns(len(handles), most)
    figure.legend(
        handles=in_rows(handles, columns),
        loc="outside upper left",
        ncols=columns,
        title=title,
        alignment="left",
        **settings,
    )


def legend_below(figure: Figure, references: Sequence[Line2D | Patch]) -> None:
    """Draw the legend of reference lines at the lower left of a figure, likewise."""
    columns = even_columns(len(references), REFERENCES_A_LINE)
    figure.legend(
        handles=in_rows(references, columns),
        loc="outside lower left",
        ncols=columns,
        handlelength=2.6,
        columnspacing=1.6,
    )


def even_columns(entries: int, most: int) -> int:
    """Return the number of columns that fills the least number of rows evenly.

    >>> [even_columns(entries, 4) for entries in (1, 4, 5, 7, 9)]
    [1, 4, 3, 4, 3]
    """
    rows = -(-entries // most)
    return -(-entries // max(rows, 1))


def in_rows(entries: Sequence[Entry], columns: int) -> list[Entry]:
    """Order entries so that matplotlib, which fills a legend column by column, shows them row by row.

    >>> in_rows("abcde", 3)
    ['a', 'd', 'b', 'e', 'c']
    """
    return [entry for column in range(columns) for entry in entries[column::columns]]
