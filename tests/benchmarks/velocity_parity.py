"""Compare our velocity tasks with recorded episodes of safety-gymnasium's.

python tests/benchmarks/velocity_parity.py [FOLDER]     default: tests/parity_velocity

Exits with 1 if anything differs but what Humanoid's contact forces decide: those are in the last two
columns, each as the greatest difference and the number of states in which it exceeds the tolerance.
Differences of observations are relative to max(1, |recorded|).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from recrl.environments.velocity.parity import TOLERANCE, compare_velocity_recording


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1] / "parity_velocity")
    files = sorted(parser.parse_args().folder.glob("*.npz"))
    if not files:
        print("no recordings (*.npz) in that folder")
        return 1
    print(
        "| task | states | observation | reward | costs | of | terminations "
        "| body velocities | contact forces |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    unequal = 0
    for path in files:
        episodes = compare_velocity_recording(path)
        unequal += sum(not one.equal for one in episodes)
        decided = [np.concatenate([getattr(one, name) for one in episodes]) for name in ("velocity", "force")]
        shown = " | ".join(f"{found.max():.1e} in {(found > TOLERANCE).sum()}" for found in decided)
        print(
            f"| {episodes[0].task} | {sum(one.states for one in episodes)} "
            f"| {max(one.observation for one in episodes):.1e} | {max(one.reward for one in episodes):.1e} "
            f"| {sum(one.costs for one in episodes)} | {sum(one.costly for one in episodes)} "
            f"| {sum(one.terminations for one in episodes)} | {shown} |"
        )
    print(f"\n{unequal} episodes differ (tolerance {TOLERANCE:g})")
    return int(unequal > 0)


if __name__ == "__main__":
    sys.exit(main())
