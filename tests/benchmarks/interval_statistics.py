"""How often the intervals of ``statistics.intervals`` cover the truth; its estimators beside rliable's.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.interval_statistics [--samples 4000]

Samples of n = 5, 10 and 20 runs are drawn from a normal distribution (for shares: from a binomial one), and
the 95% intervals that hold the truth are counted; the standard error of a count is about 0.004. If rliable is
installed, point estimates of 500 random tables are compared to its own.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri

from recrl.analysis.statistics.intervals import (
    Interval,
    group_difference,
    improvement_interval,
    interquartile_mean,
    mean_interval,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    stratified_bootstrap,
    wilson_interval,
)
from recrl.environments.cmdp import Floats

RUNS = (5, 10, 20)
SHARES = (0.5, 0.8, 0.95)
TABLES = 500


def mean_of_tasks(scores: Floats) -> Floats:
    """The mean over runs and tasks, [..., n, m] -> [...]."""
    return np.asarray(np.mean(scores, axis=(-2, -1)))


def intervals(generator: np.random.Generator) -> dict[str, tuple[Callable[[int], Interval], float]]:
    """A way to make an interval of n runs, and the truth, by what is estimated."""

    def table(runs: int) -> np.ndarray:
        return generator.normal(size=(runs, 1))

    def row(runs: int) -> np.ndarray:
        return generator.normal(size=runs)

    made: dict[str, tuple[Callable[[int], Interval], float]] = {
        "mean, bootstrap": (lambda n: stratified_bootstrap(table(n), mean_of_tasks, generator), 0.0),
        "interquartile mean": (lambda n: stratified_bootstrap(table(n), interquartile_mean, generator), 0.0),
        "improvement": (lambda n: improvement_interval(table(n), table(n), generator), 0.5),
        "mean, Student": (lambda n: mean_interval(row(n)), 0.0),
        "paired difference": (lambda n: paired_difference(row(n), row(n)), 0.0),
    }
    for share in SHARES:
        made[f"share of {share}, Wilson"] = (
            lambda n, p=share: wilson_interval(int(generator.binomial(n, p)), n),  # type: ignore[misc]
            share,
        )
    for ratio in (1.0, 3.0):
        made[f"two groups, spread {ratio:g} to 1, Welch"] = (
            lambda n, scale=ratio: group_difference(scale * row(n), row(n)),  # type: ignore[misc]
            0.0,
        )
    for share in SHARES[1:]:
        shift = 2.0**0.5 * float(ndtri(share))
        made[f"improvement of {share}"] = (
            lambda n, by=shift: improvement_interval(table(n) + by, table(n), generator),  # type: ignore[misc]
            share,
        )
    return made


def differences_to_rliable(generator: np.random.Generator) -> dict[str, float]:
    """The largest difference of each point estimate."""
    theirs: Any = importlib.import_module("rliable.metrics")
    thresholds, largest = np.linspace(-2.0, 2.0, 21), dict.fromkeys(("iqm", "improvement", "profile"), 0.0)
    for number in range(TABLES):
        runs, others, tasks = generator.integers((2, 2, 1), (12, 12, 6))
        x, y = generator.normal(size=(runs, tasks)), generator.normal(size=(others, tasks))
        if number % 3 == 0:
            x, y = np.round(x), np.round(y)  # ties
        profile = [np.mean(x > threshold) for threshold in thresholds]
        for name, one, other in (
            ("iqm", interquartile_mean(x), theirs.aggregate_iqm(x)),
            ("improvement", probability_of_improvement(x, y), theirs.probability_of_improvement(x, y)),
            ("profile", performance_profile(x, thresholds), profile),
        ):
            largest[name] = max(largest[name], float(np.abs(np.subtract(one, other)).max()))
    return largest


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=int, default=4000)
    samples = parser.parse_args(argv).samples
    generator = np.random.default_rng(0)
    print(f"{'95% intervals that hold the truth':36}" + "".join(f"{f'n = {runs}':>8}" for runs in RUNS))
    for name, (make, truth) in intervals(generator).items():
        shares, without = [], []
        for runs in RUNS:
            drawn = [make(runs) for _ in range(samples)]
            missing = sum(math.isnan(it.low) for it in drawn)
            shares.append(sum(it.low <= truth <= it.high for it in drawn) / (samples - missing))
            without.append(missing / samples)
        print(f"{name:36}" + "".join(f"{share:8.3f}" for share in shares), flush=True)
        if any(without):
            print(f"{'  without an interval':36}" + "".join(f"{share:8.3f}" for share in without), flush=True)
    if importlib.util.find_spec("rliable"):
        for name, difference in differences_to_rliable(generator).items():
            print(f"largest difference to rliable's {name}: {difference:.1e}")


if __name__ == "__main__":
    main()
