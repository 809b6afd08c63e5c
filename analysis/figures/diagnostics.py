"""Diagnostics of a curriculum: limit, cost, multiplier, critics and step size over training, for each method.

One figure per task, agent and cost, one column per method. From top to bottom: the agent's own cost and the
limit in force; the mean multipliers, if the agent has them; the explained variance of the reward and cost
critics; the mean KL divergence of its updates. Ticks below the costs mark policy noise in some run. Crosses
below the KL divergence mark CPO's recovery steps, which only decrease the cost. A dotted line is the target
of the KL divergence, if the agent has one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from recrl.analysis.data.cost_names import cost_suffix
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import panels, styles
from recrl.analysis.figures.styles import IN_FORCE_COLOUR, LIMIT_COLOUR, TEXT_WIDTH, MethodStyle
from recrl.analysis.statistics.curves import ShownSteps, mean_curve
from recrl.environments.cmdp import Floats
from recrl.orchestrator.files.trial_files import POLICY_NOISE

RECOVERY_CASE = 2.0  # CPO's ``case`` of a step that only decreases the cost
LARGE_MULTIPLIER = 50.0
EVENT_HEIGHT = 0.04  # of the events' marks, as a fraction of the panel's height
NOISE_MARK, RECOVERY_MARK = "|", "x"
TARGET_LINE: dict[str, Any] = {
    "color": "0.45",
    "linewidth": 0.8,
    "linestyle": (0.0, (1.0, 1.5)),
    "zorder": 1.8,
}
EXPLAINED = "explained_variance_"
LEAST_EXPLAINED = -0.5  # critics may be arbitrarily wrong; smaller values are cut off


def curriculum_diagnostics(sweep: Sweep, task: str, agent: str, *, cost: int = 0) -> Figure:
    """Draw limit, cost, multiplier, explained variances, KL divergence and events of every method.

    Args:
        sweep: with at least one update of this task and agent.
        task: its label.
        agent: the agent's label.
        cost: i, index of the cost and limit.

    Returns:
        Lines are means over seeds, bands one standard error.
    """
    trials, updates, events = (
        panels.rows_of(frame, task, agent) for frame in (sweep.trials, sweep.updates, sweep.events)
    )
    shown_steps = ShownSteps.of(trials)
    edges = shown_steps.grid()
    look = styles.styles_of(sweep)
    methods = [method for method in look if (updates["method"] == method).any()]
    quantities = (
        f"cost_{cost}",
        f"multiplier_{cost}",
        f"{EXPLAINED}reward",
        f"{EXPLAINED}cost_{cost}",
        "kl",
    )
    rows = [quantities[0], *(name for name in quantities[1:] if _known(updates, name))]
    limit = float(trials[f"deploy_limit_{cost}"].iloc[0])
    target = _target(sweep, task, agent)
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.15 * len(rows) + 0.85), layout="constrained")
        grid = figure.subplots(len(rows), len(methods), squeeze=False, sharex=True, sharey="row")
        for column, method in zip(grid.T, methods, strict=True):
            chosen = updates[updates["method"] == method]
            by_quantity = dict(zip(rows, column, strict=True))
            for quantity, axes in by_quantity.items():
                _panel(axes, chosen, quantity, edges, look[method])
                panels.phase_boundary(axes, shown_steps.boundary, shown_steps.total)
            _limits(column[0], chosen, f"limit_{cost}")
            noise = events.loc[_is_noise(events, method), "end_step"]
            _event_marks(column[0], noise, look[method], NOISE_MARK)
            column[0].axhline(limit, color=LIMIT_COLOUR, linewidth=1.1, linestyle=panels.DASHED, zorder=2.4)
            if "kl" in by_quantity:
                _divergence_marks(by_quantity["kl"], chosen, look[method], target)
            column[0].set_title(method)
            panels.step_axis(column[-1], 0.0, shown_steps.total)
            column[-1].set_xlabel("environment steps")
        largest = updates[f"cost_{cost}"].fillna(0.0).max()  # 0 before the first episode has finished
        scale = _scale_costs(grid[0], limit, float(largest))
        for axes, quantity in zip(grid[:, 0], rows, strict=True):
            label = _label(quantity, cost_suffix(sweep, cost, task))
            label += f"\n{scale}" if scale and axes is grid[0, 0] else ""
            axes.set_ylabel(label, fontsize=7.0)
            _scale(axes, updates, quantity)
        _legend(figure, f"{panels.panel_title(trials, updates)}, {agent}", updates["seed"].nunique(), target)
    return figure


def _target(sweep: Sweep, task: str, agent: str) -> float | None:
    """Return the KL divergence that the agent's updates aim at or end at; None if it has none."""
    target = sweep.agent_options[task, agent].get("target_kl")
    return float(target) if isinstance(target, int | float) else None


def _label(quantity: str, suffix: str) -> str:
    """Return the label of an axis.

    Args:
        quantity: the column that is drawn.
        suffix: of ``cost_suffix`` for the figure's cost.
    """
    if quantity == "kl":
        return "KL divergence"
    kind = quantity.removeprefix(EXPLAINED).split("_")[0]
    if kind != "reward":
        kind += suffix
    return f"explained\nvariance, {kind}" if quantity.startswith(EXPLAINED) else kind


def _panel(axes: Axes, updates: pd.DataFrame, quantity: str, edges: Floats, style: MethodStyle) -> None:
    if not _known(updates, quantity):
        return
    curve = mean_curve(updates, quantity, edges)
    drawn = np.isfinite(curve.centre)
    axes.plot(curve.steps[drawn], curve.centre[drawn], color=style.colour, linewidth=1.1, zorder=3.0)
    panels.draw_band(axes, curve, style)


def _limits(axes: Axes, updates: pd.DataFrame, quantity: str) -> None:
    """Draw every run's limit; infinite limits are left out."""
    for _, run in updates.groupby("seed"):
        values = run[quantity].where(np.isfinite(run[quantity]))
        axes.plot(
            run["end_step"], values, color=IN_FORCE_COLOUR, linewidth=0.8, drawstyle="steps-pre", zorder=2.5
        )


def _divergence_marks(axes: Axes, updates: pd.DataFrame, style: MethodStyle, target: float | None) -> None:
    """Draw CPO's recovery steps and the target of the KL divergence."""
    if "case" in updates:
        recovering = updates.loc[updates["case"] == RECOVERY_CASE, "end_step"]
        _event_marks(axes, recovering, style, RECOVERY_MARK)
    if target is not None:
        axes.axhline(target, **TARGET_LINE)


def _scale_costs(row: Sequence[Axes], limit: float, largest: float) -> str:
    """Scale the shared axis of the costs and shade above the limit; return the scale for its label."""
    scale = panels.cost_axis(row[0], limit, largest)
    low, high = row[0].get_ylim()
    for axes in row:
        panels.shade_above_limit(axes, limit)
    row[0].set_ylim(low, max(high, 1.2 * limit))
    return scale


def _scale(axes: Axes, updates: pd.DataFrame, quantity: str) -> None:
    """Scale the shared axis of another quantity."""
    if quantity.startswith(EXPLAINED):
        axes.set_ylim(LEAST_EXPLAINED, 1.05)
    if quantity.startswith("multiplier_") and updates[quantity].max() > LARGE_MULTIPLIER:
        axes.set_yscale("symlog", linthresh=1.0)  # CPO's have spikes
        axes.set_ylim(bottom=-0.3)


def _event_marks(axes: Axes, steps: Iterable[float], style: MethodStyle, marker: str) -> None:
    """Draw a mark at the lower edge for every event."""
    known = sorted(set(steps))
    if not known:
        return
    axes.plot(
        known,
        [EVENT_HEIGHT] * len(known),
        color=style.colour,
        linestyle="none",
        marker=marker,
        markersize=3.0,
        markeredgewidth=0.7,
        transform=axes.get_xaxis_transform(),
        zorder=2.0,
    )


def _legend(figure: Figure, title: str, seeds: int, target: float | None) -> None:
    line = "mean ± standard error" if seeds > 1 else "the one run"
    handles: list[Line2D | Patch] = [
        Line2D([], [], color="0.2", linewidth=1.1, label=line),
        Line2D([], [], color=IN_FORCE_COLOUR, linewidth=0.9, label="limit in force, every run"),
        Line2D([], [], color=LIMIT_COLOUR, linewidth=1.1, linestyle=panels.DASHED, label="limit $d_d$"),
        panels.above_limit_patch(),
        Line2D([], [], color="black", linewidth=0.8, linestyle=panels.DASHED, label="deployment begins"),
        Line2D([], [], color="0.2", linestyle="none", marker=NOISE_MARK, label="noise added (below cost)"),
        Line2D([], [], color="0.2", linestyle="none", marker=RECOVERY_MARK, label="recovery step (below KL)"),
    ]
    if target is not None:
        handles.append(Line2D([], [], **TARGET_LINE, label=f"target of the KL divergence, {target:g}"))
    panels.legend_above(figure, handles, most=panels.REFERENCES_A_LINE, title=title)


def _is_noise(events: pd.DataFrame, method: str) -> pd.Series[bool]:
    return (events["method"] == method) & (events["event"] == POLICY_NOISE)


def _known(updates: pd.DataFrame, quantity: str) -> bool:
    return quantity in updates and bool(np.isfinite(updates[quantity]).any())
