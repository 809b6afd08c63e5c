"""Final policies on RiverGrid: their visits and movements, drawn on the map.

One row per task, one column per method. Each map is the mean over the method's runs. A square's shade is the
expected number of steps on it in an episode. An arrow has the direction of a heading; its length is the
probability of going forward, its darkness that of a visit. A dot means that the policy mostly turns. Visits,
returns and costs are not sampled, but computed from the tables of policy and task
(``exact_solver.evaluate_policy``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from recrl.analysis.data.exact_values import policy_table
from recrl.analysis.data.labels import occurring
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import styles
from recrl.analysis.figures.styles import TEXT_WIDTH
from recrl.environments.cmdp import Floats
from recrl.environments.finite.exact_solver import evaluate_policy
from recrl.environments.registry import task_options
from recrl.environments.rivergrid.grid_world import (
    FORWARD,
    HEADINGS,
    RiverGridOptions,
    river_cmdp,
    task_map,
)
from recrl.environments.rivergrid.maps import GOAL, MUD, RIVER, STEPS, WALL, RiverMap
from recrl.orchestrator.errors import USERS_ERRORS
from recrl.orchestrator.number_texts import number

TILE_COLOURS = {WALL: "#4a4a4a", RIVER: "#b9dcf2", MUD: "#d9c29a", GOAL: "#a8dba8"}
DRY_COLOUR = "#f6f1e4"
VISIT_COLOURS = "Oranges"
LEAST_VISITS = 0.01  # squares and headings with fewer visits per episode are not drawn
MAX_COLUMNS = 5


@dataclass(frozen=True, eq=False)
class MeanBehaviour:
    """Mean behaviour of a method's runs.

    Attributes:
        visits: expected visits of each (state, action) pair in an episode, [S, A], the mean over runs.
        episode_return: expected, the mean over runs.
        costs: expected, the mean over runs, [k].
        runs: n.
    """

    visits: Floats
    episode_return: float
    costs: Floats
    runs: int


def policy_maps(sweep: Sweep, agent: str) -> Figure | None:
    """Draw the final policies of an agent on the maps of its RiverGrid tasks.

    Args:
        sweep: its trials with a policy table that fits the task are drawn.
        agent: the agent's label.

    Returns:
        The figure, or None if there is no such trial.
    """
    policies = sweep.policies[sweep.policies["agent"] == agent]
    tasks, methods = occurring(policies["task"]), occurring(policies["method"])
    maps = {task: found for task in tasks if (found := river_task(sweep, task)) is not None}
    behaviours = {
        (task, method): behaviour
        for task, found in maps.items()
        for method in methods
        for chosen in [policies[(policies["task"] == task) & (policies["method"] == method)]]
        if (behaviour := mean_behaviour(chosen, *found)) is not None
    }
    if not behaviours:
        return None
    maps = {task: found for task, found in maps.items() if any(task == drawn for drawn, _ in behaviours)}
    rows, columns, panels_of_a_map = _layout(len(maps), len(methods))
    scale = LogNorm(vmin=0.1, vmax=max(options.horizon for _, options in maps.values()))
    with styles.context():
        figure = Figure(figsize=(TEXT_WIDTH, 1.7 * rows + 0.3), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
            axes.set(xticks=[], yticks=[])  # invisible ticks would still take space in the layout
        for number, (task, (river_map, _)) in enumerate(maps.items()):
            panels = grid.reshape(-1)[number * panels_of_a_map :][:panels_of_a_map]
            for axes, method in zip(panels, methods, strict=False):
                if (behaviour := behaviours.get((task, method))) is not None:
                    draw_map(axes, river_map)
                    _draw_behaviour(axes, river_map, behaviour, scale)
                    _title(axes, method, behaviour)
            first = panels[0]
            first.text(-0.07, 0.5, task, transform=first.transAxes, rotation=90, ha="right", va="center")
        bar = figure.colorbar(ScalarMappable(scale, VISIT_COLOURS), ax=grid, shrink=0.6, aspect=30, pad=0.01)
        gap = " " if rows > 1 else "\n"  # one row is lower than the label is long
        bar.set_label(f"expected steps{gap}on the square, an episode", fontsize=6.0)
        title = f"{agent}: stochastic final policies, exactly evaluated; the mean over runs"
        figure.suptitle(title, fontsize=7.0, x=0.02, ha="left")  # a phone shows the left half
    return figure


def _layout(num_maps: int, num_methods: int) -> tuple[int, int, int]:
    """Return rows and columns of the grid of panels, and the number of consecutive panels per map.

    Each map has rows of its own; with a single method, the maps are side by side.
    """
    if num_methods == 1:
        rows = math.ceil(num_maps / MAX_COLUMNS)
        return rows, math.ceil(num_maps / rows), 1
    columns = min(MAX_COLUMNS, num_methods)
    lines = math.ceil(num_methods / columns)
    return lines * num_maps, columns, lines * columns


def river_task(sweep: Sweep, task: str) -> tuple[RiverMap, RiverGridOptions] | None:
    """Return the map and the settings of a task, if it is a RiverGrid that can be built here."""
    name = str(sweep.trials.loc[sweep.trials["task"] == task, "task_name"].iloc[0])
    if name.partition("-")[0] != "rivergrid":
        return None
    try:
        options = task_options(name, sweep.task_options[task])
        if not isinstance(options, RiverGridOptions):
            return None
        return task_map(name, options), options
    except USERS_ERRORS:  # options of another version: the sweep has a note of it
        return None


def mean_behaviour(
    policies: pd.DataFrame, river_map: RiverMap, options: RiverGridOptions
) -> MeanBehaviour | None:
    """Evaluate the policies of several runs exactly, and average.

    Policy tables that do not fit the task are left out. The result is None if none fits.

    Args:
        policies: rows of ``Sweep.policies``, of one task, agent and method.
        river_map: the task's.
        options: the task's.
    """
    model = river_cmdp(river_map, costs=options.costs, horizon=options.horizon)
    values = []
    for _, run in policies.groupby("seed"):
        if (table := policy_table(run, model)) is not None:
            values.append(evaluate_policy(model, table))
    if not values:
        return None
    return MeanBehaviour(
        visits=np.mean([value.visits for value in values], axis=0),
        episode_return=float(np.mean([value.episode_return for value in values])),
        costs=np.mean([value.costs for value in values], axis=0),
        runs=len(values),
    )


def draw_map(axes: Axes, river_map: RiverMap) -> None:
    """Draw the tiles; x to the right, y downwards."""
    colours = [[to_rgb(TILE_COLOURS.get(tile, DRY_COLOUR)) for tile in row] for row in river_map.rows]
    axes.pcolormesh(np.array(colours), edgecolors="white", linewidth=0.3)
    for x, y in river_map.cells(GOAL):
        axes.text(x + 0.5, y + 0.5, "G", ha="center", va="center", fontsize=6.0)
    x, y = river_map.start
    axes.add_patch(Rectangle((x + 0.06, y + 0.06), 0.88, 0.88, fill=False, linewidth=0.8, zorder=4.0))
    axes.set_xlim(0, river_map.width)
    axes.set_ylim(river_map.height, 0)
    axes.set_aspect("equal")


def _draw_behaviour(axes: Axes, river_map: RiverMap, behaviour: MeanBehaviour, scale: LogNorm) -> None:
    """Draw shades, inset so that the tile below stays visible, then arrows and dots."""
    visits = behaviour.visits.reshape(river_map.width, river_map.height, HEADINGS, -1)
    squares = np.argwhere(visits.sum(axis=(2, 3)) >= LEAST_VISITS)
    steps = visits.sum(axis=(2, 3))[tuple(squares.T)]
    insets = [Rectangle((x + 0.14, y + 0.14), 0.72, 0.72) for x, y in squares.tolist()]
    shades = ScalarMappable(scale, VISIT_COLOURS).to_rgba(steps)
    # the edge distinguishes a visited square from the river in greyscale
    axes.add_collection(
        PatchCollection(insets, facecolors=shades, edgecolors="0.3", linewidths=0.3, zorder=2.0)
    )
    arrows, dots = [], []
    for x, y, heading in np.argwhere(visits.sum(axis=3) >= LEAST_VISITS).tolist():
        seen, (right, down) = float(visits[x, y, heading].sum()), STEPS[heading]
        forward = float(visits[x, y, heading, FORWARD]) / seen
        opacity = min(1.0, 0.15 + 0.85 * seen)
        start = (x + 0.5 + 0.1 * right, y + 0.5 + 0.1 * down)
        if forward < 0.5:
            dots.append((*start, opacity))
        else:
            arrows.append((*start, 0.6 * forward * right, 0.6 * forward * down, opacity))
    if dots:
        across, down_to, opacities = np.array(dots).T
        axes.scatter(across, down_to, s=2.0, color=_black(opacities), linewidths=0.0, zorder=5.0)
    if arrows:
        *vectors, opacities = np.array(arrows).T
        axes.quiver(
            *vectors,
            color=_black(opacities),
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.009,
            headwidth=4.5,
            headlength=5.0,
            headaxislength=4.5,
            zorder=5.0,
        )


def _black(opacities: Floats) -> list[tuple[float, float, float, float]]:
    return [(0.0, 0.0, 0.0, float(opacity)) for opacity in opacities]


def _title(axes: Axes, method: str, behaviour: MeanBehaviour) -> None:
    costs = ", ".join(number(round(float(cost), 3)) for cost in behaviour.costs)
    head = f"{method}, {behaviour.runs} run{'s' if behaviour.runs > 1 else ''}"
    axes.set_title(f"{head}\nreturn {number(behaviour.episode_return)}, cost {costs}", fontsize=6.0, pad=2.0)
