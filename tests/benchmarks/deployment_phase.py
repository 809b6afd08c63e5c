"""Episodes of the deployment phase, in which learning goes on: the paper's measure, beside final policies.

    python tests/benchmarks/deployment_phase.py SWEEP [SWEEP ...] --to rows.csv
    python tests/benchmarks/differences.py rows.csv --against none --policy phase

A sweep is a folder or an export. A row is a complete trial and a period, with the mean return and cost of the
episodes that finished in it: the whole ``phase``, the updates that begin in its ``first`` 100,000 steps, and
those that end in its ``last``. Episodes that finish soon after the phase has begun, began before it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

import recrl
from recrl.analysis.data.sweep_data import Sweep

KEYS = ["task", "agent", "method", "seed"]
STEPS = 100_000


def periods(updates: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the updates of each period, by its name."""
    phase = updates[updates["phase"] == "deployment"]
    ends = phase.groupby(KEYS, observed=True)["end_step"]
    of_update = updates.groupby(KEYS, observed=True)["end_step"].transform("min").loc[phase.index]
    begin, end = ends.transform("min") - of_update, ends.transform("max")
    return {
        "phase": phase,
        "first": phase[phase["end_step"] - of_update < begin + STEPS],
        "last": phase[phase["end_step"] > end - STEPS],
    }


def means(updates: pd.DataFrame, period: str) -> pd.DataFrame:
    """Return the mean over the episodes of some updates, a row a trial."""
    finished = updates[updates["episodes"] > 0]
    sums = finished.assign(
        episode_return=finished["episode_return"] * finished["episodes"],
        cost=finished["cost_0"] * finished["episodes"],
    )
    trials = sums.groupby(KEYS, observed=True)[["episodes", "episode_return", "cost"]].sum()
    return pd.DataFrame(
        {
            "policy": period,
            "episodes": trials["episodes"],
            "return": (trials["episode_return"] / trials["episodes"]).round(3),
            "cost": (trials["cost"] / trials["episodes"]).round(3),
        }
    ).reset_index()


def of_complete(sweep: Sweep) -> pd.DataFrame:
    """Return the updates of the complete trials."""
    return sweep.updates.merge(sweep.trials.loc[sweep.trials["status"] == "complete", KEYS], on=KEYS)


def main() -> None:
    """Write the rows of some sweeps."""
    parser = argparse.ArgumentParser(description="What the episodes of the deployment phase earn and cost.")
    parser.add_argument("sweeps", type=Path, nargs="+")
    parser.add_argument("--to", type=Path, required=True)
    arguments = parser.parse_args()
    updates = pd.concat([of_complete(recrl.load_sweep(path)) for path in arguments.sweeps], ignore_index=True)
    if updates.duplicated([*KEYS, "end_step"]).any():
        raise SystemExit("a trial is in several sweeps")
    rows = pd.concat([means(part, name) for name, part in periods(updates).items()], ignore_index=True)
    rows.sort_values([*KEYS, "policy"]).to_csv(arguments.to, index=False, lineterminator="\n")


if __name__ == "__main__":
    main()
