"""Does CPO's integral of the violations hold the mean cost at the limit? What it ignored, a row a trial.

    python tests/benchmarks/ignored_violations.py runs/safety-gym-table --to ignored.csv

It takes sweeps; exports lack the metrics. The violation of an update is the agent's estimate of the mean
episode cost minus the limit. Columns: its mean over the second half of the steps and over the last fifth;
over the second half also the mean of what the integral ignored (0 where it did not), the share of such
updates, and the share of recovery steps. An integral that ignores nothing holds the mean violation at 0.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

import recrl

KEYS = ["task", "agent", "method", "seed"]
RECOVERY = 2.0


def row(updates: pd.DataFrame) -> dict[str, float]:
    """The columns of one trial."""
    violations, integral = updates["cost_gap_0"], updates["violation_integral_0"]
    ignored = violations.where((integral.diff() == 0.0) & (violations > 0.0), 0.0)
    share = updates["end_step"] / updates["end_step"].max()
    late = share > 0.5
    return {
        "violation": violations[late].mean(),
        "violation_last_fifth": violations[share > 0.8].mean(),
        "ignored": ignored[late].mean(),
        "ignored_share": (ignored[late] > 0.0).mean(),
        "recovery_share": (updates["case"][late] == RECOVERY).mean(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print and write a row a trial of the sweeps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sweeps", nargs="+", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    given = parser.parse_args(arguments)
    rows = []
    for sweep in given.sweeps:
        for key, updates in recrl.load_sweep(sweep).updates.groupby(KEYS, observed=True):
            rows.append(dict(zip(KEYS, key, strict=True)) | row(updates))
    table = pd.DataFrame(rows).round(3)
    table.to_csv(given.to, index=False)
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
