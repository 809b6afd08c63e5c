"""Learning curves over seeds, on a common grid of environment steps."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
import pandas as pd

from recrl.analysis.statistics.intervals import CONFIDENCE, ENOUGH_RUNS, interquartile_mean
from recrl.analysis.statistics.verdicts import is_cost
from recrl.environments.cmdp import Floats

BINS = 100  # of a trial's steps, at most
BAND_REPLICATIONS = 500  # a band has a hundred intervals
BAND_ENDS = ((1.0 - CONFIDENCE) / 2.0, (1.0 + CONFIDENCE) / 2.0)


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity over training, averaged over seeds on a grid of environment steps.

    Attributes:
        steps: centres of the grid's bins, [g].
        centre: mean or interquartile mean over the runs with data in the bin, [g]; NaN without any.
        low: lower end of the band, [g]; NaN with fewer than two such runs.
        high: upper end, likewise.
    """

    steps: Floats
    centre: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class CurveAverage:
    """Method that turns several runs into a line with a band.

    Attributes:
        description: of line and band, for legends.
        curve: (updates, column, edges) as in ``mean_curve``.
        enough_runs: with fewer the band is narrower than its nominal level.
    """

    description: str
    curve: Callable[[pd.DataFrame, str, Floats], Curve]
    enough_runs: int = 1

    def describe(self, runs: Collection[int]) -> str:
        """Return the description, with a warning for too few runs; a single run has no band.

        Args:
            runs: number of runs of each line, at least one line.
        """
        if max(runs) == 1:
            return "one seed, no interval"
        fewest = min(count for count in runs if count > 1)
        warning = f"; {fewest} seeds are too few for it: the band is too narrow"
        single = "; a line without a band is one seed"
        return self.description + warning * (fewest < self.enough_runs) + single * (min(runs) == 1)


def step_grid(boundary_step: int, total_steps: int, *, updates: int, bins: int) -> Floats:
    """Return edges of bins over a trial's steps, one at the phase boundary so that no bin mixes phases.

    Args:
        boundary_step: first step under d_d.
        total_steps: environment steps of the trial.
        updates: policy updates of the trial: there are never more bins than updates.
        bins: number of bins over the whole trial, at least 2.

    Returns:
        Ascending edges from 0 to ``total_steps``, about [min(bins, updates) + 1].
    """
    count = max(2, min(bins, updates))
    if not 0 < boundary_step < total_steps:
        return np.linspace(0.0, total_steps, count + 1)
    deployment = min(max(1, round(count * (1.0 - boundary_step / total_steps))), count - 1)
    training = np.linspace(0.0, boundary_step, count - deployment + 1)
    return np.concatenate([training, np.linspace(boundary_step, total_steps, deployment + 1)[1:]])


@dataclass(frozen=True)
class ShownSteps:
    """The environment steps that a figure of several trials shows, and the policy updates in them.

    Attributes:
        boundary: first environment step under d_d, of the trial that comes to it first.
        total: environment steps of the longest trial.
        updates: policy updates in ``total``, if they are as short as the shortest.
    """

    boundary: int
    total: int
    updates: int

    @classmethod
    def of(cls, trials: pd.DataFrame) -> Self:
        """Return the steps of trials of one task and agent; rows of ``Sweep.trials``."""
        total = int(trials["total_steps"].max())
        return cls(int(trials["boundary_step"].min()), total, int(total // trials["steps_per_update"].min()))

    def grid(self) -> Floats:
        """Return the ``step_grid`` with at most ``BINS`` bins."""
        return step_grid(self.boundary, self.total, updates=self.updates, bins=BINS)


def binned_runs(updates: pd.DataFrame, column: str, edges: Floats) -> Floats:
    """Return every run's curve on a common grid.

    A bin (e_j, e_j+1] has the mean of the run's updates that end in it, weighted by their numbers of
    episodes, or NaN. Limits and the agent's own metrics are not weighted.

    Args:
        updates: of one task, agent and method; of a ``Sweep``.
        column: the averaged column.
        edges: ascending, [g + 1].

    Returns:
        [n, g], runs in the order of their seeds.
    """
    weighted = column == "episode_return" or is_cost(column)
    values = updates[column].to_numpy(np.float64)
    weights = updates["episodes"].to_numpy(np.float64) if weighted else np.ones(len(updates))
    bins = np.searchsorted(edges, updates["end_step"].to_numpy(np.float64), side="left") - 1
    seeds, runs = np.unique(updates["seed"].to_numpy(), return_inverse=True)
    count = len(edges) - 1
    usable = np.isfinite(values) & (weights > 0.0) & (bins >= 0) & (bins < count)
    cells, size = runs[usable] * count + bins[usable], len(seeds) * count
    sums = np.bincount(cells, weights[usable] * values[usable], minlength=size)
    totals = np.bincount(cells, weights[usable], minlength=size)
    means: Floats = np.divide(sums, totals, out=np.full(size, np.nan), where=totals > 0.0)
    return np.reshape(means, (len(seeds), count))


def mean_curve(updates: pd.DataFrame, column: str, edges: Floats) -> Curve:
    """Return mean and standard error over seeds of ``binned_runs``.

    Args:
        updates: of one task, agent and method.
        column: the averaged column.
        edges: ascending, [g + 1].
    """
    runs = binned_runs(updates, column, edges)
    present = np.isfinite(runs)
    count = present.sum(axis=0)
    mean = _divided(np.where(present, runs, 0.0).sum(axis=0), count)
    squares = np.where(present, (runs - mean) ** 2, 0.0).sum(axis=0)
    error = np.sqrt(_divided(squares, (count - 1) * count))
    return Curve(_centres(edges), mean, mean - error, mean + error)


def interquartile_curve(
    updates: pd.DataFrame, column: str, edges: Floats, generator: np.random.Generator
) -> Curve:
    """Return the interquartile mean over seeds of ``binned_runs``, with a 95% bootstrap band.

    Whole runs are resampled, so that neighbouring bins have the same resamples.

    Args:
        updates: of one task, agent and method.
        column: the averaged column.
        edges: ascending, [g + 1].
        generator: draws the resamples.
    """
    runs = binned_runs(updates, column, edges)
    present = np.isfinite(runs)
    centre, low, high = np.full((3, runs.shape[1]), np.nan)
    patterns, pattern_of = np.unique(present, axis=1, return_inverse=True)
    for index, members in enumerate(patterns.T):
        bins = np.flatnonzero(pattern_of.reshape(-1) == index)
        scores = runs[np.ix_(members, bins)].T  # [b, n] of the n runs with data in these b bins
        count = scores.shape[1]
        if count == 0:
            continue
        centre[bins] = interquartile_mean(scores[:, :, None])
        if count > 1:
            resampled = generator.integers(count, size=(BAND_REPLICATIONS, count))
            replicated = interquartile_mean(scores[:, resampled][..., None])
            low[bins], high[bins] = np.quantile(replicated, BAND_ENDS, axis=-1)
    return Curve(_centres(edges), centre, low, high)


MEAN = CurveAverage("mean ± standard error over seeds", mean_curve)


def interquartile(generator: np.random.Generator) -> CurveAverage:
    """Interquartile means with bootstrap bands.

    Args:
        generator: draws the resamples.
    """
    return CurveAverage(
        "interquartile mean and its 95% bootstrap band over seeds",
        lambda updates, column, edges: interquartile_curve(updates, column, edges, generator),
        ENOUGH_RUNS,
    )


def _centres(edges: Floats) -> Floats:
    return (edges[:-1] + edges[1:]) / 2.0


def _divided(numerator: Floats, denominator: npt.NDArray[np.integer]) -> Floats:
    """Return the quotient, NaN where the denominator is not positive."""
    return np.where(denominator > 0, numerator / np.maximum(denominator, 1), np.nan)
