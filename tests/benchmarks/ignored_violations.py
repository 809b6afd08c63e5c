"""Where does CPO's integral of the violations hold the mean cost? What it did not count, a row a trial.

    python tests/benchmarks/ignored_violations.py --code 74b0588 runs/safety-gym-table --to ignored.csv

It takes sweeps, of one version of the code after each ``--code``; exports lack the metrics. The violation
of an update is the agent's estimate of the mean episode cost minus the limit. Columns, over the second half
of the steps of complete trials: its mean, the mean of the violations that the integral did not count or
that its bound removed (0 elsewhere), the share of such updates, the share of recovery steps, and the mean
and the largest value of the integral. The mean violation over the last fifth stands beside them. An
integral that ends where it began, and never is 0, holds the mean of what it counts at 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

import recrl

KEYS = ["task", "agent", "method", "seed"]
RECOVERY = 2.0
GAIN = 0.03  # the default of violation_integral_gain
ROUNDING = 1e-6


def row(updates: pd.DataFrame) -> dict[str, float]:
    """The columns of one trial."""
    violations, integral = updates["cost_gap_0"], updates["violation_integral_0"]
    counted = integral.diff() / GAIN
    missed = (violations - counted).where(counted < violations - ROUNDING, 0.0)
    share = updates["end_step"] / updates["end_step"].max()
    late = share > 0.5
    return {
        "violation": violations[late].mean(),
        "violation_last_fifth": violations[share > 0.8].mean(),
        "not_counted": missed[late].mean(),
        "not_counted_share": (missed[late] > 0.0).mean(),
        "recovery_share": (updates["case"][late] == RECOVERY).mean(),
        "integral": integral[late].mean(),
        "largest_integral": integral.max(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print and write a row a trial."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--code", nargs="+", action="append", required=True, help="a commit, then its sweeps")
    parser.add_argument("--to", type=Path, required=True)
    given = parser.parse_args(arguments)
    rows = []
    for code, *sweeps in given.code:
        for sweep in sweeps:
            data = recrl.load_sweep(sweep)
            complete = data.trials[data.trials["status"] == "complete"]
            for key, updates in data.updates.groupby(KEYS, observed=True):
                names = dict(zip(KEYS, key, strict=True))
                if ((complete[KEYS] == list(key)).all(axis=1)).any():
                    rows.append({"code": code} | names | row(updates))
    table = pd.DataFrame(rows).round(3)
    table.to_csv(given.to, index=False)
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
