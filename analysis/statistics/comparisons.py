"""Differences between curricula, or between agents, with intervals and tests: from tables to tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import BASELINE, GROUP, KEY
from recrl.analysis.statistics.intervals import (
    Difference,
    Interval,
    group_difference,
    holm,
    improvement_interval,
    paired_difference,
)
from recrl.analysis.statistics.verdicts import is_cost, tie

# Columns of outcomes that a comparison reads, beside cost_i.
NEEDED = (*KEY, "measure", "episode_return", "feasible", "optimal_return")

Compare = Callable[..., Difference]  # paired_difference or group_difference


def comparisons(
    rows: pd.DataFrame, generator: np.random.Generator, *, baseline: str = BASELINE
) -> pd.DataFrame:
    """Compare every method with one of them, paired: one row per other GROUP and measure with a common seed.

    All pairs count, feasible or not. More return is a gain only where feasible_pairs equals pairs. The p
    values are corrected for the rows that are given: choose tasks, agents and methods before the call.

    Args:
        rows: of ``outcomes``, or others with NEEDED, and cost_i where costs are compared.
        generator: draws the resamples.
        baseline: name (label) of the method that the others are compared with.

    Returns:
        GROUP, measure, baseline, and the columns below. Returns tie as in ``verdicts.tie``, costs only where
        they differ by rounding.

        * pairs, feasible_pairs: number of seeds that both have, and of those whose two trials are feasible.
        * return_difference, _low, _high: mean paired difference to the baseline, with Student's 95% interval.
        * return_difference_p: its p value, NaN for one pair. Otherwise it is 1 if all pairs tie, and NaN if
          the differences do not vary.
        * return_difference_p_corrected: the same, corrected by ``holm`` for all rows of the measure.
        * cost_i_difference and so on: likewise; the p values of each cost are corrected separately.
        * improvement, _low, _high: probability that a run returns more than a run of the baseline, of these
          seeds, with its bootstrap interval. Ties count half.
        * too_few_seeds: the bootstrap interval is too short.

    Raises:
        ValueError: a column is missing, no row has the given baseline, or a trial is in the rows twice.
            Without ``none`` the table is empty by default.
    """
    _check_rows(rows)
    if baseline != BASELINE:
        _check_label(rows, "method", baseline)
    lines = []
    for line, *sides in _beside(rows, "method", baseline):
        seeds = sides[0][["seed"]].merge(sides[1][["seed"]])
        ours, theirs = (seeds.merge(side) for side in sides)
        if len(seeds):
            both = ours["feasible"].to_numpy(bool) & theirs["feasible"].to_numpy(bool)
            line |= {"pairs": len(both), "feasible_pairs": int(both.sum())}
            lines.append(line | _differences(ours, theirs, generator, paired_difference))
    return _compared(lines, rows, ["pairs", "feasible_pairs"])


def group_comparisons(
    rows: pd.DataFrame, generator: np.random.Generator, *, of: Literal["method", "agent"], baseline: str
) -> pd.DataFrame:
    """Compare methods, or agents, with one of them, as independent groups of seeds.

    For runs that share little but the number of a seed, such as two agents. All seeds with a complete trial
    count, feasible or not, also those that only one side has. More return is a gain only where all seeds of
    both sides are feasible.

    Args:
        rows: as for ``comparisons``.
        generator: draws the resamples.
        of: what is compared: methods with the same agent, or agents under the same method.
        baseline: name (label) of the method, or agent, that the others are compared with.

    Returns:
        One row per other GROUP and measure, with the columns of ``comparisons``, but intervals and p values
        of Welch's t test. A p value is 1 if every run ties every run of the baseline, and NaN if a side has
        one seed. In place of the pairs are seeds and feasible_seeds, and those of the baseline:
        baseline_seeds and baseline_feasible_seeds.

    Raises:
        ValueError: ``of`` is something else, a column is missing, no row has the given baseline, or a trial
            is in the rows twice.
    """
    if of not in ("method", "agent"):
        raise ValueError(f"of: must be 'method' or 'agent', got {of!r}")
    _check_rows(rows)
    _check_label(rows, of, baseline)
    lines = []
    for line, ours, theirs in _beside(rows, of, baseline):
        line |= {"seeds": len(ours), "feasible_seeds": int(ours["feasible"].sum())}
        line |= {"baseline_seeds": len(theirs), "baseline_feasible_seeds": int(theirs["feasible"].sum())}
        lines.append(line | _differences(ours, theirs, generator, group_difference))
    counts = ["seeds", "feasible_seeds"]
    return _compared(lines, rows, [*counts, *(f"baseline_{name}" for name in counts)])


def _check_rows(rows: pd.DataFrame) -> None:
    if missing := [name for name in NEEDED if name not in rows]:
        unknown = "where J*(d_d) is unknown optimal_return is NaN"
        raise ValueError(f"rows: no column {', '.join(missing)}; {unknown}")
    twice = rows[rows.duplicated([*KEY, "measure"])]
    if len(twice):
        names = ", ".join(str(twice.iloc[0][name]) for name in (*KEY, "measure"))
        raise ValueError(f"rows: a trial is there twice: {names}")


def _check_label(rows: pd.DataFrame, of: str, baseline: str) -> None:
    if not (rows[of] == baseline).any():
        known = ", ".join(map(str, dict.fromkeys(rows[of])))
        raise ValueError(f"baseline: no complete trial has the {of} {baseline!r} (found: {known})")


def _beside(
    rows: pd.DataFrame, of: str, baseline: str
) -> Iterator[tuple[dict[str, Any], pd.DataFrame, pd.DataFrame]]:
    """Yield labels, outcomes and those of the baseline, for each other GROUP and measure that has both."""
    same = [name for name in (*GROUP, "measure") if name != of]
    bases = dict(iter(rows[rows[of] == baseline].groupby(same, observed=True)))
    for group, chosen in rows.groupby([*GROUP, "measure"], observed=True, sort=False):
        line: dict[str, Any] = dict(zip((*GROUP, "measure"), group, strict=True))
        others = bases.get(tuple(line[name] for name in same))
        if line[of] != baseline and others is not None:
            yield line | {"baseline": baseline}, chosen, others


def _differences(
    ours: pd.DataFrame, theirs: pd.DataFrame, generator: np.random.Generator, compare: Compare
) -> dict[str, Any]:
    """Return the differences in return and costs between two groups of outcomes.

    Args:
        ours: a row a seed.
        theirs: of the baseline; for pairs with the same seeds in the same order.
        generator: draws the resamples.
        compare: gives difference, interval and test of two columns.
    """
    tie_of_returns = tie(float(ours["optimal_return"].iloc[0]))
    line: dict[str, Any] = {}
    for name in ("episode_return", *filter(is_cost, map(str, ours))):
        values, base = ours[name].to_numpy(np.float64), theirs[name].to_numpy(np.float64)
        difference = compare(values, base, tie=tie_of_returns if name == "episode_return" else tie(math.nan))
        column = f"{name.removeprefix('episode_')}_difference"
        line |= _ends(column, difference) | {f"{column}_p": difference.p_value}
    returns, base = (it["episode_return"].to_numpy(np.float64)[:, None] for it in (ours, theirs))
    improvement = improvement_interval(returns, base, generator, tie=tie_of_returns)
    return line | _ends("improvement", improvement) | {"too_few_seeds": improvement.is_small}


def _compared(lines: Sequence[dict[str, Any]], rows: pd.DataFrame, counts: Sequence[str]) -> pd.DataFrame:
    """Return a table of differences, with corrected p values; its columns exist even without a line.

    Args:
        lines: a mapping a row, without the corrected p values.
        rows: the outcomes that were compared.
        counts: names of the columns after the measure.
    """
    differing = [f"{name}_difference" for name in ("return", *filter(is_cost, map(str, rows)))]
    ends = [f"{name}{end}" for name in differing for end in ("", "_low", "_high", "_p", "_p_corrected")]
    improved = ["improvement", "improvement_low", "improvement_high", "too_few_seeds"]
    table = pd.DataFrame(lines, columns=[*GROUP, "measure", "baseline", *counts, *ends, *improved])
    of_measures = table.groupby("measure", sort=False)
    for name in differing:
        corrected = of_measures[f"{name}_p"].transform(lambda them: holm(them.to_numpy(np.float64)))
        table[f"{name}_p_corrected"] = corrected
    return table


def _ends(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.estimate, f"{name}_low": interval.low, f"{name}_high": interval.high}
