"""Which violations CPO's integral does not count, and how large the mean violation is: a row a trial.

    python tests/benchmarks/uncounted_violations.py --code f585952 runs/safety-gym-table --to uncounted.csv

After each ``--code`` come the sweeps that ran with it; exports lack the metrics. The violation of an update
is the agent's estimate of the mean episode cost minus the limit. Uncounted is the part of it that the
integral did not add, or that its bound removed. An integral that ends where it began, and never is 0, has
counted violations that average to 0. So the mean of all violations is that of the uncounted ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

import recrl

KEYS = ["task", "agent", "method", "seed"]
RECOVERY = 2.0
GAIN = 0.03  # the default of violation_integral_gain
ROUNDING = 1e-6


def row(updates: pd.DataFrame) -> dict[str, float]:
    """The columns of one trial; means and shares are over the second half of its steps, where not said."""
    violations, integral = updates["cost_gap_0"], updates["violation_integral_0"]
    counted = integral.diff() / GAIN
    uncounted = (violations - counted).where(counted < violations - ROUNDING, 0.0)
    share = updates["end_step"] / updates["end_step"].max()
    late = share > 0.5
    return {
        "violation": violations[late].mean(),
        "violation_last_fifth": violations[share > 0.8].mean(),
        "uncounted": uncounted[late].mean(),
        "uncounted_share": (uncounted[late] > 0.0).mean(),
        "recovery_share": (updates["case"][late] == RECOVERY).mean(),
        "integral": integral[late].mean(),
        "largest_integral": integral.max(),
    }


def rows_of(code: str, sweep: str) -> list[dict[str, Any]]:
    """A row a complete trial of a sweep."""
    data = recrl.load_sweep(sweep)
    complete = data.updates.merge(data.trials.loc[data.trials["status"] == "complete", KEYS])
    trials = complete.groupby(KEYS, observed=True)
    return [{"code": code} | dict(zip(KEYS, key, strict=True)) | row(updates) for key, updates in trials]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print and write a row a trial."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--code", nargs="+", action="append", required=True, help="a commit, then its sweeps")
    parser.add_argument("--to", type=Path, required=True)
    given = parser.parse_args(arguments)
    table = pd.DataFrame(
        [row for code, *sweeps in given.code for sweep in sweeps for row in rows_of(code, sweep)]
    )
    table.round(3).to_csv(given.to, index=False)
    print(table.round(3).to_string(index=False))


if __name__ == "__main__":
    main()
