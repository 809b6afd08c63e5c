"""The figures of a sweep: which there are, their file names and captions, and the kinds of their curves."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from recrl.analysis.data.cost_names import cost_suffix
from recrl.analysis.data.labels import ordered
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import learning_curves
from recrl.analysis.figures.cumulative_cost import cumulative_bounds
from recrl.analysis.figures.diagnostics import curriculum_diagnostics
from recrl.analysis.figures.frontier import return_against_cost
from recrl.analysis.figures.policy_map import policy_maps
from recrl.analysis.figures.profiles import performance_profiles
from recrl.analysis.report.table_files import BOOTSTRAP_SEED, COST_AND_BOUNDS, COST_AND_LIMITS
from recrl.analysis.statistics.cumulative_cost import is_bounded
from recrl.analysis.statistics.curves import MEAN, CurveAverage, interquartile
from recrl.analysis.statistics.metrics import Measure
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import RecrlError

CAPTIONS = {
    "return-against-cost": "Final policies: return against cost. The shaded region is above the limit; "
    "filled marks are feasible, every cost within the tolerance of its limit, hollow ones are not; a failed "
    "trial has no mark",
    "learning-curves": "Return and cost while training, and magnified in the deployment phase (learning goes "
    "on). Costs in the shaded region are above the limit",
    "curricula": "Cost limits in force",
    "diagnostics": "Limit, cost, multiplier, explained variance of the critics, and KL divergence",
    "policies": "Final policies and their visits",
    "performance-profiles": "Fraction of final policies that are feasible and return more than the value "
    "below; an infeasible one and a failed trial count as the worst",
}
KINDS = frozenset({*CAPTIONS, "bounds"})  # the captions of bounds depend on the sweep
SKETCHED = ("return-against-cost", "learning-curves", "curricula")


@dataclass(frozen=True)
class Drawing:
    """A figure that can be drawn.

    Attributes:
        kind: the beginning of its file's name, and the key of its caption in CAPTIONS.
        make: draws it; returns None without data.
        about: the labels that the figure is about, which its caption begins with; may be empty.
        shows: the caption of a kind that is not in CAPTIONS, because it depends on the sweep.
    """

    kind: str
    make: Callable[[], Figure | None]
    about: tuple[str, ...] = ()
    shows: str = ""

    @property
    def caption(self) -> str:
        """The caption: the labels as in the grid, and what the figure shows."""
        shows = self.shows or CAPTIONS[self.kind]
        return f"{', '.join(self.about)}: {shows}" if self.about else shows


class NothingToDrawError(RecrlError):
    """The sweep has no policy update on disk yet."""


def drawings(sweep: Sweep, *, averaging: CurveAverage = MEAN) -> dict[str, Drawing]:
    """Return the figures of a sweep by file stem; each is drawn when it is called.

    Args:
        sweep: its frames.
        averaging: of the learning curves.

    Raises:
        NothingToDrawError: no trial has committed a policy update yet.
    """
    if not len(sweep.updates):
        raise NothingToDrawError(
            f"{sweep.name}: nothing to draw yet, because no trial has committed a policy update "
            f"({counted(len(sweep.trials), 'trial')})"
        )
    agents = ordered(list(sweep.updates["agent"]), list(sweep.trials["agent"].cat.categories))
    cells = sweep.updates[["task", "agent"]].drop_duplicates().astype(str).to_numpy().tolist()
    made: dict[str, Drawing] = {}

    def add(drawing: Drawing, *labels: str) -> None:
        made[_free_stem("_".join((drawing.kind, *map(_safe, labels))), made)] = drawing

    add(Drawing("return-against-cost", partial(return_against_cost, sweep)))
    episodeless = without_episodes(sweep)
    for agent in (it for it in agents if it not in episodeless):
        curves = partial(learning_curves.learning_curves, sweep, agent, averaging=averaging)
        add(Drawing("learning-curves", curves, (agent,)), agent)
    add(Drawing("curricula", partial(learning_curves.curricula, sweep)))
    about: tuple[str, ...]
    for task, agent in cells:
        for i in range(int(sweep.trials.loc[sweep.trials["task"] == task, "num_costs"].max())):
            suffix = cost_suffix(sweep, i, task)
            diagnosed = partial(curriculum_diagnostics, sweep, task, agent, cost=i)
            about = (task, agent, *_cost_label(suffix))
            add(Drawing("diagnostics", diagnosed, about), task, agent, *_file_label(i))
    for agent in agents:
        add(Drawing("policies", partial(policy_maps, sweep, agent), (agent,)), agent)
    for agent in agents:
        for i in range(sweep.num_costs):
            about = (agent, *_cost_label(cost_suffix(sweep, i)))
            shows = COST_AND_BOUNDS if is_bounded(sweep, agent, cost=i) else COST_AND_LIMITS
            summed = partial(cumulative_bounds, sweep, agent, cost=i)
            add(Drawing("bounds", summed, about, shows), agent, *_file_label(i))
    add(Drawing("performance-profiles", partial(performance_profiles, sweep, Measure.STOCHASTIC)))
    return made


def curve_averages() -> dict[str, CurveAverage]:
    """Return the kinds of lines and bands, by their names on the command line."""
    return {"mean": MEAN, "iqm": interquartile(np.random.default_rng(BOOTSTRAP_SEED))}


def _cost_label(suffix: str) -> tuple[str, ...]:
    """Return the label of one of several costs, from its ``cost_suffix``."""
    return (f"cost{suffix}",) if suffix else ()


def _file_label(i: int) -> tuple[str, ...]:
    """Return what tells the files of several costs apart: the number of the CSV files' columns."""
    return (f"cost-{i}",) if i else ()


def _safe(label: str) -> str:
    """Return a label as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", label)


def _free_stem(stem: str, taken: Collection[str]) -> str:
    """Return the stem, with a counter if another figure has it, as two labels may differ only in other signs.

    Upper and lower case count as equal, because some file systems do not tell them apart.

    >>> _free_stem("bounds_-0.1", ["bounds_-0.1", "Bounds_-0.1-2"]), _free_stem("curricula", [])
    ('bounds_-0.1-3', 'curricula')
    """
    known = {it.casefold() for it in taken}
    numbered = (f"{stem}-{count}" for count in itertools.count(2))
    return next(it for it in itertools.chain([stem], numbered) if it.casefold() not in known)


def without_episodes(sweep: Sweep) -> list[str]:
    """Return the agents that have updates, but no finished episode in any of them."""
    finished = sweep.updates["episode_return"].notna().groupby(sweep.updates["agent"], observed=True).any()
    return [str(agent) for agent in finished.index[~finished]]
