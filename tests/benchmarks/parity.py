"""Check our Safety Gym tasks against all recorded episodes in a folder.

python tests/benchmarks/parity.py [FOLDER]

Prints one line an episode; exits with 1 if anything differs by more than 1e-5, or any cost or goal differs.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from recrl.environments.safety_gym.parity import TOLERANCE, compare_recording


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1] / "parity")
    files = sorted(parser.parse_args().folder.glob("*.npz"))
    if not files:
        print("no recordings (*.npz) in that folder")
        return 1
    print(
        f"{'task':14}{'policy':10}{'states':>7}{'observation':>13}{'reward':>10}  goals and costs that differ"
    )
    compared = [comparison for path in files for comparison in compare_recording(path)]
    for one in compared:
        differing = {"goals": one.goals, **one.costs}
        text = ", ".join(f"{name} {count}" for name, count in differing.items() if count) or "none"
        costly = ", ".join(f"{name} {count}" for name, count in one.costly.items())
        print(
            f"{one.task:14}{one.policy:10}{one.states:7}{one.observation:13.1e}{one.reward:10.1e}"
            f"  {text} (of {costly})"
        )
    states, unequal = sum(one.states for one in compared), sum(not one.equal for one in compared)
    print(f"{len(compared)} episodes, {states} states: {unequal} differ (tolerance {TOLERANCE:g})")
    return int(unequal > 0)


if __name__ == "__main__":
    sys.exit(main())
