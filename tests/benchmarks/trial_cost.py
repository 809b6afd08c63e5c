"""What trials cost: wall and CPU seconds, and the share of rollouts and updates in them.

    python tests/benchmarks/trial_cost.py SWEEP_FOLDER [SWEEP_FOLDER ...] --to cost.csv

Reads the files of complete trials in folders of sweeps; an export does not have the clock columns.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd


def costs(folders: list[Path]) -> Iterator[dict[str, Any]]:
    """Yield a row a complete trial; wall seconds of a trial that was resumed contain the time between."""
    for path in sorted(path for folder in folders for path in folder.glob("trials/*/state.json")):
        state = json.loads(path.read_text())
        if state["status"] == "complete":
            updates = pd.read_csv(path.with_name("updates.csv"))
            yield {
                "trial": path.parent.name.rpartition("__")[0],
                "attempts": state["attempt"],
                "wall_seconds": round(state["heartbeat"] - state["started_at"]),
                "cpu_seconds": round(state["cpu_seconds"]),
                "rollout_seconds": round(updates["collect_seconds"].sum()),
                "update_seconds": round(updates["update_seconds"].sum()),
            }


def main() -> None:
    """Write the rows, and print their means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--to", type=Path, required=True)
    given = parser.parse_args()
    table = pd.DataFrame(costs(given.folders))
    table.to_csv(given.to, index=False)
    print(table.describe().round(1).to_string())


if __name__ == "__main__":
    main()
